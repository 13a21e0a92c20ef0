"""Steps, their derivatives and batches of fabrics lower for accelerators, with none at hand."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import pytest

import r2s
from r2s.materials import presets
from r2s.solvers.implicit.linear.system import Elimination
from r2s.solvers.mpm import Grid
from r2s.solvers.mpm.sheet import MPMCloth

PLATFORMS = ("cuda", "tpu")


def scene() -> r2s.Scene:
    sheet = r2s.rectangle((0.1, 0.1), (4, 4))
    return r2s.Scene(sheet, [0], table=0.0)


def cloth() -> r2s.ImplicitCloth:
    return r2s.ImplicitCloth(scene(), dt=0.01)


def by_dissection() -> r2s.ImplicitCloth:
    """As on an accelerator, where no loop over a band of vertices is wanted."""
    mesh = scene().mesh
    return dataclasses.replace(cloth(), elimination=Elimination.make(mesh, order="dissection"))


def by_generalised_alpha() -> r2s.ImplicitCloth:
    return r2s.ImplicitCloth(scene(), dt=0.01, spectral_radius=0.6)


def explicit() -> r2s.ExplicitCloth:
    return r2s.ExplicitCloth(scene(), 0.01, presets.black_denim())


def points() -> MPMCloth:
    grid = Grid.covering((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), 0.05)
    return MPMCloth(scene(), 1e-4, presets.black_denim(), grid, membrane_damping=1e-4)


def height(solver) -> Callable:
    """The mean height [m] of a sheet after two steps, of a fabric."""
    rest = solver.scene.mesh.rest
    start = jnp.concatenate([rest + 0.2, jnp.full((len(rest), 1), 0.25)], axis=1)
    control = r2s.Control(jnp.broadcast_to(start[0], (2, 1, 3)))
    state = solver.init(start)
    return lambda fabric: r2s.simulate(solver, fabric, state, control).x[-1, :, 2].mean()


def lowered(function: Callable, fabric: r2s.Fabric) -> str:
    leaves, structure = jax.tree.flatten(fabric)

    def flat(*leaves):
        return jax.tree.leaves(function(jax.tree.unflatten(structure, leaves)))

    found = jax.export.export(jax.jit(flat), platforms=PLATFORMS)(*leaves)
    assert found.platforms == PLATFORMS
    module = found.mlir_module()
    assert "lapack" not in module  # which is there on a CPU alone
    return module


def batch(fabric: r2s.Fabric) -> r2s.Fabric:
    return jax.tree.map(lambda leaf: jnp.stack([leaf, 1.1 * leaf]), fabric)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("make", [cloth, by_dissection, by_generalised_alpha, explicit, points])
def test_a_motion_its_gradient_and_its_batch_lower_for_accelerators(make):
    function, fabric = height(make()), presets.black_denim()
    alone = lowered(function, fabric)
    assert len(lowered(jax.grad(function), fabric)) > len(alone)
    many = lowered(jax.vmap(jax.grad(function)), batch(fabric))
    assert "tensor<2x16x3x" in many  # two members of 16 vertices


@pytest.mark.slow(group="cloth")
def test_a_longer_motion_makes_no_larger_a_program():
    """Time is a loop of the program: nothing is unrolled over steps."""
    solver, fabric = cloth(), presets.black_denim()
    start = jnp.pad(solver.scene.mesh.rest, ((0, 0), (0, 1)), constant_values=0.01)

    def size(steps: int) -> int:
        control = r2s.Control(jnp.zeros((steps, 1, 3)))
        return len(
            lowered(lambda f: r2s.simulate(solver, f, solver.init(start), control).x, fabric)
        )

    assert abs(size(40) - size(2)) < 0.01 * size(2)  # numbers in the text have more digits
