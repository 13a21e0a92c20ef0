"""The losses on exact fields, which obey the equations of motion at the true stiffness only."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jaxtyping import Array

from r2s.estimation.pinn import published_recipe, weak_form
from r2s.estimation.pinn.network import Jet, Network
from r2s.estimation.pinn.pulls import Clamp, Pull
from r2s.estimation.pinn.training import NOISE, losses_of
from r2s.estimation.pinn.weak_form import end_value, virtual_fields
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane

# compiled as a whole, which is faster than one operation after the other
compiled: Any = eqx.filter_jit
marker_residual = compiled(weak_form.marker_residual)
motion_residual = compiled(published_recipe.motion_residual)
kinematics, virtual_work = compiled(weak_form.kinematics), compiled(weak_form.virtual_work)

SIZE, DENSITY, FRAMES = (0.45, 0.3), 0.3, 7  # [m, kg/m^2]
TRUE = (90.0, 25.0, 140.0, 30.0)  # C11, C12, C22, C33 [N/m]
FABRIC = Fabric.make(DENSITY, TRUE, 1e-5, damping=0.0)


class Exact(eqx.Module):
    """A displacement in closed form in place of a network."""

    function: object = eqx.field(static=True)
    scale: Array

    def __call__(self, points):
        return jax.vmap(self.one)(points)

    def one(self, point):
        return self.scale * self.function(point)  # pyright: ignore[reportCallIssue]

    def jet(self, points, pairs):
        first = jax.vmap(jax.jacfwd(self.one))(points)
        second = jax.vmap(jax.hessian(self.one))(points)
        chosen = [second[:, :, i, j] for i, j in pairs]
        chosen = jnp.stack(chosen) if chosen else jnp.zeros((0, len(points), 2))
        return Jet(self(points), jnp.moveaxis(first, 2, 0), chosen)


def exact(function) -> Exact:
    return Exact(function, jnp.ones(()))


def pull(function, force=None, angle: float = 0.0, normal: float = 0.0, duration: float = 0.02):
    """A pull whose markers are where the closed form says; its clamps do not move."""
    zero = jnp.zeros((FRAMES, 2))
    clamp, times = Clamp(zero, zero, zero), jnp.linspace(0.0, duration, FRAMES)
    places = jnp.array(SIZE)[None] * jr.uniform(jr.key(0), (12, 2))
    given = Pull(
        size=jnp.array(SIZE),
        angle=jnp.asarray(angle),
        places=places,
        displacement=jnp.zeros((FRAMES, 12, 2)),
        seen=jnp.ones((FRAMES, 12), bool),
        times=times,
        near=clamp,
        far=clamp,
        force=force,
        gravity=jnp.zeros(2),
        normal=jnp.asarray(normal),
    )
    return dataclasses.replace(given, displacement=marker_residual(exact(function), given))


def waves(law: OrthotropicMembrane, wave=(7.0, 10.0), size: float = 1e-3):
    """Two plane waves of small strain: the eigenvectors of the Christoffel matrix [N/m^3]."""
    k, m = wave
    matrix = np.array(
        [
            [law.c11 * k**2 + law.c33 * m**2, (law.c12 + law.c33) * k * m],
            [(law.c12 + law.c33) * k * m, law.c33 * k**2 + law.c22 * m**2],
        ]
    )
    squares, directions = np.linalg.eigh(matrix / DENSITY)

    def displacement(point):
        phase = k * point[0] + m * point[1]
        parts = [
            size * direction * jnp.sin(phase + np.sqrt(square) * point[2] + i)
            for i, (square, direction) in enumerate(zip(squares, directions.T, strict=True))
        ]
        return jnp.sum(jnp.stack(parts), axis=0)

    return displacement


def inner_points(given: Pull, count: int = 40):
    keys = jr.split(jr.key(1))
    places = jr.uniform(keys[0], (count, 2)) * given.size[None]
    return places, jr.randint(keys[1], (count,), 0, FRAMES)


ISOTROPIC = OrthotropicMembrane.isotropic(8e4, 0.3, 1e-3)


@pytest.mark.parametrize("law", [FABRIC.membrane, ISOTROPIC], ids=["orthotropic", "isotropic"])
def test_waves_obey_the_equation_of_motion(law):
    function = waves(law)
    given, fabric = pull(function), dataclasses.replace(FABRIC, membrane=law)

    def residual(fabric):
        return motion_residual(exact(function), given, fabric, *inner_points(given))

    twice = dataclasses.replace(fabric, density=2 * fabric.density)
    assert float(jnp.abs(residual(fabric)).max()) < 1e-9 * float(jnp.abs(residual(twice)).max())


def test_exact_waves_give_all_four_stiffnesses():
    """The residual is linear in them: least squares, without force, since the inertia is known."""
    first, second = (waves(FABRIC.membrane, wave) for wave in ((7.0, 10.0), (9.0, -4.0)))

    def function(point):
        return first(point) + second(point)

    given = pull(function)

    def residual(stiffness):
        fabric = dataclasses.replace(FABRIC, membrane=OrthotropicMembrane(*stiffness))
        field = exact(function)
        return motion_residual(field, given, fabric, *inner_points(given)).ravel()

    start = jnp.full(4, 10.0)
    found = start - jnp.linalg.lstsq(jax.jacfwd(residual)(start), residual(start))[0]
    np.testing.assert_allclose(found, TRUE, rtol=1e-6)


def stretched(rate: float):
    """Even stretching by `rate` [1/s] with the lateral contraction of a uniaxial pull."""
    poisson = TRUE[1] / TRUE[2]

    def displacement(point):
        e = rate * point[2]
        along = (1 + e) ** 2 / 2 - 0.5  # Green strain
        across = jnp.sqrt(1 - 2 * poisson * along) - 1
        return jnp.stack([e * point[0], across * (point[1] - SIZE[1] / 2)])

    return displacement


def uniaxial_force(rate: float, times):
    """F S11 times the width [N], with S11 = (C11 - C12^2 / C22) E11."""
    e = rate * times
    along = (1 + e) ** 2 / 2 - 0.5
    return (1 + e) * (TRUE[0] - TRUE[1] ** 2 / TRUE[2]) * along * SIZE[1]


def test_virtual_work_of_an_even_stretch_is_the_force():
    function = stretched(2.0)
    given, virtual = pull(function), virtual_fields((3, 4), 8)
    still = eqx.tree_at(lambda f: f.density, FABRIC, jnp.zeros(()))
    motion = kinematics(exact(function), given, virtual, jnp.arange(FRAMES))
    work = virtual_work(still, given, virtual, motion)
    expected = uniaxial_force(2.0, given.times)
    np.testing.assert_allclose(work[:, -1, 0] / end_value(virtual), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(work[:, :-1], 0, atol=1e-11)


def test_virtual_work_is_that_of_the_strong_form():
    """Integrated by parts: of a wave, with the traction of its free edges taken out."""
    function = waves(FABRIC.membrane)
    given, virtual = pull(function), virtual_fields((3, 4), 14)
    fabric = eqx.tree_at(lambda f: f.density, FABRIC, jnp.asarray(2 * DENSITY))
    motion = kinematics(exact(function), given, virtual, jnp.arange(FRAMES))
    work = virtual_work(fabric, given, virtual, motion)
    right = virtual_work(FABRIC, given, virtual, motion)
    inertia = DENSITY * motion.acceleration  # what the wrong density adds
    weights = virtual.weights * SIZE[0] * SIZE[1]
    expected = jnp.einsum("q,tqi,fq->tfi", weights, inertia, virtual.value)
    np.testing.assert_allclose(work - right, expected, rtol=1e-9, atol=1e-12)


def test_work_is_linear_in_the_stiffness():
    function = stretched(2.0)
    given, virtual = pull(function), virtual_fields((3, 4), 8)
    motion = kinematics(exact(function), given, virtual, jnp.arange(FRAMES))

    def work(stiffness):
        membrane = OrthotropicMembrane(*stiffness)
        return virtual_work(dataclasses.replace(FABRIC, membrane=membrane), given, virtual, motion)

    true = jnp.array(TRUE)
    mean = (work(true / 2) + work(3 * true / 2)) / 2
    np.testing.assert_allclose(work(true), mean, rtol=1e-10, atol=1e-14)


def test_friction_resists_the_motion():
    """On a table the pull needs the force of friction too: that of the whole sheet's even slip."""
    function = stretched(2.0)
    given = pull(function, normal=9.81)
    virtual = virtual_fields((3, 4), 10)
    motion = kinematics(exact(function), given, virtual, jnp.arange(FRAMES))
    loose = eqx.tree_at(lambda f: f.friction, FABRIC, jnp.zeros(()))
    work = virtual_work(FABRIC, given, virtual, motion)
    more = work - virtual_work(loose, given, virtual, motion)
    # all of it slips along X, fastest at the far clamp: half the limit, since the work counts x / L
    limit = 0.5 * DENSITY * 9.81 * SIZE[0] * SIZE[1] / 2
    np.testing.assert_allclose(more[-1, -1, 0] / end_value(virtual), limit, rtol=0.1)


@pytest.mark.slow(group="pinn")
def test_each_loss_is_one_when_its_error_is_the_noise():
    """Of the markers, and of the force; the exact motion of a sheet without inertia has none."""
    function = stretched(2.0)
    given = pull(function)
    expected = uniaxial_force(2.0, given.times)
    given = dataclasses.replace(given, force=expected)
    still = eqx.tree_at(lambda f: f.density, FABRIC, jnp.zeros(()))

    def terms(given, fabric=still):
        return losses_of(exact(function), given, fabric, jnp.arange(FRAMES))

    right = terms(given)
    assert max(float(right.data), float(right.work), float(right.force)) < 1e-12
    moved = dataclasses.replace(given, displacement=given.displacement + NOISE[0])
    np.testing.assert_allclose(terms(moved).data, 1.0, rtol=1e-9)
    more = dataclasses.replace(given, force=expected + NOISE[1] * jnp.max(expected))
    np.testing.assert_allclose(terms(more).force, 1.0, rtol=0.03)
    softer = eqx.tree_at(lambda f: f.membrane.c12, still, jnp.asarray(5.0))
    assert float(terms(given, softer).force) > 1 and float(terms(given, softer).work) > 1


@pytest.mark.slow(group="pinn")
def test_losses_have_finite_gradients():
    given = pull(stretched(2.0), force=jnp.full(FRAMES, 3.0), normal=9.81)
    network = Network.make(
        jnp.array([*SIZE, 0.02]), jnp.asarray(0.01), width=5, layers=3, key=jr.key(3)
    )

    def loss(network):
        return sum(losses_of(network, given, FABRIC, jnp.arange(3)))

    gradient = jax.jit(jax.grad(loss))(network)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
    assert not np.any(gradient.scale)  # scales are not trained
