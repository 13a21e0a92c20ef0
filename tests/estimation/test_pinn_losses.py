"""The network's derivatives, the stress in a sheet, and the losses on exact fields, which obey the
equations of motion at the true stiffness only."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.pinn import published_recipe, weak_form
from r2s.estimation.pinn.network import Jet, Network, Perceptron, T, X, Y
from r2s.estimation.pinn.pulls import Clamp, Pull
from r2s.estimation.pinn.training import NOISE, losses_of
from r2s.estimation.pinn.weak_form import (
    end_value,
    green_strain,
    nominal_stress,
    small_strain,
    virtual_fields,
)
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane, TurnedMembrane, turned

# compiled as a whole, which is faster than one operation after the other
compiled: Any = eqx.filter_jit
marker_residual = compiled(weak_form.marker_residual)
motion_residual = compiled(published_recipe.motion_residual)
kinematics, virtual_work = compiled(weak_form.kinematics), compiled(weak_form.virtual_work)

SIZE, DENSITY, FRAMES = (0.45, 0.3), 0.3, 7  # [m, kg/m^2]
TRUE = (90.0, 25.0, 140.0, 30.0)  # C11, C12, C22, C33 [N/m]
FABRIC = Fabric.make(DENSITY, TRUE, 1e-5, damping=0.0)
STILL = eqx.tree_at(lambda f: f.density, FABRIC, jnp.zeros(()))  # without inertia
ISOTROPIC = OrthotropicMembrane.isotropic(8e4, 0.3, 1e-3)
ANGLE = jnp.asarray(0.4)
TURNED = TurnedMembrane(FABRIC.membrane, ANGLE)


# Strain and stress


def gradient(key: int, size: float):
    return size * jr.normal(jr.key(key), (2, 2))


def test_green_strain_ignores_a_rotation_and_is_small_strain_when_small():
    c, s = jnp.cos(0.7), jnp.sin(0.7)
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    np.testing.assert_allclose(green_strain(rotation - jnp.eye(2)), 0, atol=1e-15)
    change = gradient(2, 1e-7)
    np.testing.assert_allclose(green_strain(change), small_strain(change), atol=1e-12)


def test_stress_is_the_derivative_of_the_energy_and_damping_that_of_the_rate():
    """Kelvin-Voigt: as if the strain were that of `damping` later, to first order."""
    at, rate = gradient(3, 0.05), gradient(4, 1e-4)
    damped = eqx.tree_at(lambda f: f.damping, FABRIC, jnp.asarray(0.02))
    elastic = nominal_stress(FABRIC, ANGLE, at)
    expected = jax.grad(lambda g: TURNED.energy_density(green_strain(g)))(at)
    np.testing.assert_allclose(elastic, expected, rtol=1e-10)
    fast = jax.jvp(green_strain, (at,), (rate,))[1]
    viscous = 0.02 * jax.grad(TURNED.energy_density)(fast)  # the law is linear
    expected = jax.vjp(green_strain, at)[1](viscous)[0]
    np.testing.assert_allclose(
        nominal_stress(damped, ANGLE, at, rate) - elastic, expected, rtol=1e-9
    )


def test_turning_a_strain_turns_its_tensor_and_leaves_an_isotropic_law():
    strain = jnp.array([0.02, -0.01, 0.03])
    e11, e22, shear = strain
    tensor = jnp.array([[e11, shear / 2], [shear / 2, e22]])
    c, s = jnp.cos(ANGLE), jnp.sin(ANGLE)
    axes = jnp.array([[c, s], [-s, c]])  # warp and weft
    local = axes @ tensor @ axes.T
    expected = jnp.array([local[0, 0], local[1, 1], 2 * local[0, 1]])
    np.testing.assert_allclose(turned(strain, ANGLE), expected)
    energy = TurnedMembrane(ISOTROPIC, ANGLE).energy_density(strain)
    np.testing.assert_allclose(energy, ISOTROPIC.energy_density(strain), rtol=1e-12)


# The network


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("pairs", [((X, X), (X, Y), (Y, Y), (T, T)), ((X, T), (Y, T), (T, T))])
def test_jets_are_the_derivatives(pairs):
    high = jnp.array([0.45, 0.3, 1.2])
    network = Network.make(high, jnp.asarray(0.02), width=9, layers=4, key=jr.key(0))
    points = jr.uniform(jr.key(1), (5, 3)) * high[None]
    jet = network.jet(points, pairs)

    def one(point):
        return network(point[None])[0]

    first = jax.vmap(jax.jacrev(one))(points)
    second = jax.vmap(jax.hessian(one))(points)
    np.testing.assert_allclose(jet.value, network(points), rtol=1e-12)
    np.testing.assert_allclose(jet.first, jnp.moveaxis(first, 2, 0), rtol=1e-9, atol=1e-14)
    for derivative, (i, j) in zip(jet.second, pairs, strict=True):
        np.testing.assert_allclose(derivative, second[:, :, i, j], rtol=1e-9, atol=1e-13)


# The strong form


class Exact(Network):
    """A displacement in closed form in place of a network."""

    function: Any = eqx.field(static=True)

    def __call__(self, points):
        return jax.vmap(self.one)(points)

    def one(self, point):
        return self.scale * self.function(point)

    def jet(self, points, pairs):
        first = jax.vmap(jax.jacfwd(self.one))(points)
        second = jax.vmap(jax.hessian(self.one))(points)
        chosen = [second[:, :, i, j] for i, j in pairs]
        return Jet(self(points), jnp.moveaxis(first, 2, 0), jnp.stack(chosen))


def exact(function) -> Exact:
    return Exact(Perceptron(1, 2), {}, jnp.zeros(3), jnp.ones(3), jnp.ones(()), function)


def pull(function, force=None, normal: float = 0.0):
    """A pull whose markers are where the closed form says; its clamps do not move."""
    zero = jnp.zeros((FRAMES, 2))
    clamp = Clamp(zero, zero, zero)
    still = Pull(
        size=jnp.array(SIZE),
        angle=jnp.zeros(()),
        places=jnp.array(SIZE)[None] * jr.uniform(jr.key(0), (12, 2)),
        displacement=jnp.zeros((FRAMES, 12, 2)),
        seen=jnp.ones((FRAMES, 12), bool),
        times=jnp.linspace(0.0, 0.02, FRAMES),
        near=clamp,
        far=clamp,
        force=force,
        gravity=jnp.zeros(2),
        normal=jnp.asarray(normal),
    )
    return dataclasses.replace(still, displacement=marker_residual(exact(function), still))


def waves(law: OrthotropicMembrane, wave=(7.0, 10.0), size: float = 1e-3):
    """Two plane waves of small strain: the eigenvectors of the Christoffel matrix [N/m^3]."""
    k, m = wave
    mixed = (law.c12 + law.c33) * k * m
    along, across = law.c11 * k**2 + law.c33 * m**2, law.c33 * k**2 + law.c22 * m**2
    squares, directions = np.linalg.eigh(np.array([[along, mixed], [mixed, across]]) / DENSITY)

    def displacement(point):
        phase = k * point[0] + m * point[1]
        parts = [
            size * direction * jnp.sin(phase + np.sqrt(square) * point[2] + i)
            for i, (square, direction) in enumerate(zip(squares, directions.T, strict=True))
        ]
        return jnp.sum(jnp.stack(parts), axis=0)

    return displacement


def strong_residual(function, fabric):
    keys = jr.split(jr.key(1))
    places = jr.uniform(keys[0], (40, 2)) * jnp.array(SIZE)[None]
    frames = jr.randint(keys[1], (40,), 0, FRAMES)
    return motion_residual(exact(function), pull(function), fabric, places, frames)


@pytest.mark.parametrize("law", [FABRIC.membrane, ISOTROPIC], ids=["orthotropic", "isotropic"])
def test_waves_obey_the_equation_of_motion(law):
    fabric = dataclasses.replace(FABRIC, membrane=law)
    heavy = dataclasses.replace(fabric, density=2 * fabric.density)
    right, wrong = (jnp.abs(strong_residual(waves(law), f)).max() for f in (fabric, heavy))
    assert float(right) < 1e-9 * float(wrong)


def test_exact_waves_give_all_four_stiffnesses():
    """The residual is linear in them: least squares, without force, since the inertia is known."""
    first, second = (waves(FABRIC.membrane, wave) for wave in ((7.0, 10.0), (9.0, -4.0)))

    def residual(stiffness):
        fabric = dataclasses.replace(FABRIC, membrane=OrthotropicMembrane(*stiffness))
        return strong_residual(lambda point: first(point) + second(point), fabric).ravel()

    start = jnp.full(4, 10.0)
    solution = start - jnp.linalg.lstsq(jax.jacfwd(residual)(start), residual(start))[0]
    np.testing.assert_allclose(solution, TRUE, rtol=1e-6)


# The weak form


def stretched(point):
    """Even stretching by 2 / s with the lateral contraction of a uniaxial pull."""
    e = 2.0 * point[2]
    along = (1 + e) ** 2 / 2 - 0.5  # Green strain
    across = jnp.sqrt(1 - 2 * TRUE[1] / TRUE[2] * along) - 1
    return jnp.stack([e * point[0], across * (point[1] - SIZE[1] / 2)])


def uniaxial_force(times):
    """F S11 times the width [N], with S11 = (C11 - C12^2 / C22) E11."""
    e = 2.0 * times
    along = (1 + e) ** 2 / 2 - 0.5
    return (1 + e) * (TRUE[0] - TRUE[1] ** 2 / TRUE[2]) * along * SIZE[1]


def worker(function, count: int, normal: float = 0.0):
    """The pull, its virtual displacements and motion, and the work of a fabric."""
    given, virtual = pull(function, normal=normal), virtual_fields((3, 4), count)
    motion = kinematics(exact(function), given, virtual, jnp.arange(FRAMES))
    return given, virtual, motion, lambda fabric: virtual_work(fabric, given, virtual, motion)


def test_virtual_work_of_an_even_stretch_is_the_force():
    given, virtual, _, work_of = worker(stretched, 8)
    work = work_of(STILL)
    expected = uniaxial_force(given.times)
    np.testing.assert_allclose(work[:, -1, 0] / end_value(virtual), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(work[:, :-1], 0, atol=1e-11)


def test_virtual_work_is_that_of_the_strong_form():
    """Integrated by parts: of a wave, with the traction of its free edges taken out."""
    _, virtual, motion, work_of = worker(waves(FABRIC.membrane), 14)
    heavy = eqx.tree_at(lambda f: f.density, FABRIC, jnp.asarray(2 * DENSITY))
    inertia = DENSITY * motion.acceleration  # what the wrong density adds
    weights = virtual.weights * SIZE[0] * SIZE[1]
    expected = jnp.einsum("q,tqi,fq->tfi", weights, inertia, virtual.value)
    np.testing.assert_allclose(work_of(heavy) - work_of(FABRIC), expected, rtol=1e-9, atol=1e-12)


def test_friction_resists_the_motion():
    """On a table the pull needs the force of friction too: that of the whole sheet's even slip."""
    _, virtual, _, work_of = worker(stretched, 10, normal=9.81)
    loose = eqx.tree_at(lambda f: f.friction, FABRIC, jnp.zeros(()))
    more = work_of(FABRIC) - work_of(loose)
    # all of it slips along X, fastest at the far clamp: half the limit, since the work counts x / L
    limit = 0.5 * DENSITY * 9.81 * SIZE[0] * SIZE[1] / 2
    np.testing.assert_allclose(more[-1, -1, 0] / end_value(virtual), limit, rtol=0.1)


@pytest.mark.slow(group="pinn")
def test_each_loss_is_one_when_its_error_is_the_noise():
    """Of the markers, and of the force; the exact motion of a sheet without inertia has none."""
    given = pull(stretched)
    expected = uniaxial_force(given.times)
    given = dataclasses.replace(given, force=expected)

    def terms(given, fabric=STILL):
        return losses_of(exact(stretched), given, fabric, jnp.arange(FRAMES))

    right = terms(given)
    assert max(float(right.data), float(right.work), float(right.force)) < 1e-12
    moved = dataclasses.replace(given, displacement=given.displacement + NOISE[0])
    np.testing.assert_allclose(terms(moved).data, 1.0, rtol=1e-9)
    more = dataclasses.replace(given, force=expected + NOISE[1] * jnp.max(expected))
    np.testing.assert_allclose(terms(more).force, 1.0, rtol=0.03)
    softer = eqx.tree_at(lambda f: f.membrane.c12, STILL, jnp.asarray(5.0))
    assert float(terms(given, softer).force) > 1 and float(terms(given, softer).work) > 1


@pytest.mark.slow(group="pinn")
def test_losses_have_finite_gradients():
    given = pull(stretched, force=jnp.full(FRAMES, 3.0), normal=9.81)
    high = jnp.array([*SIZE, 0.02])
    network = Network.make(high, jnp.asarray(0.01), width=5, layers=3, key=jr.key(3))
    loss = jax.jit(jax.grad(lambda n: sum(losses_of(n, given, FABRIC, jnp.arange(3)))))
    gradient = loss(network)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
    assert not np.any(gradient.scale)  # scales are not trained
