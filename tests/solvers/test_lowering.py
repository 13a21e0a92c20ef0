"""Steps, their derivatives and batches of fabrics lower for accelerators, with none at hand."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import pytest

import r2s
from r2s.materials import presets
from r2s.solvers.implicit.system import Elimination
from r2s.solvers.mpm import Grid

PLATFORMS = ("cuda", "tpu")


SCENE = r2s.Scene(r2s.rectangle((0.1, 0.1), (4, 4)), [0], table=0.0)
GRID = Grid.covering((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), 0.05)
DISSECTED = Elimination.make(SCENE.mesh, order="dissection")  # as on an accelerator
SOLVERS = {
    "band": lambda: r2s.ImplicitCloth(SCENE, 0.01),
    "dissection": lambda: r2s.ImplicitCloth(SCENE, 0.01, elimination=DISSECTED),
    "generalised alpha": lambda: r2s.ImplicitCloth(SCENE, 0.01, spectral_radius=0.6),
    "explicit": lambda: r2s.ExplicitCloth(SCENE, 0.01, presets.black_denim()),
    "mpm": lambda: r2s.MPMCloth(SCENE, 1e-4, presets.black_denim(), GRID, membrane_damping=1e-4),
}


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


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("name", SOLVERS)
def test_a_motion_its_gradient_and_its_batch_lower_for_accelerators(name):
    function, fabric = height(SOLVERS[name]()), presets.black_denim()
    alone = lowered(function, fabric)
    assert len(lowered(jax.grad(function), fabric)) > len(alone)
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.1 * leaf]), fabric)
    many = lowered(jax.vmap(jax.grad(function)), two)
    assert "tensor<2x16x3x" in many  # two members of 16 vertices


@pytest.mark.slow(group="cloth")
def test_a_longer_motion_makes_no_larger_a_program():
    """Time is a loop of the program: nothing is unrolled over steps."""
    solver, fabric = SOLVERS["band"](), presets.black_denim()
    start = jnp.pad(solver.scene.mesh.rest, ((0, 0), (0, 1)), constant_values=0.01)

    def size(steps: int) -> int:
        control = r2s.Control(jnp.zeros((steps, 1, 3)))
        return len(
            lowered(lambda f: r2s.simulate(solver, f, solver.init(start), control).x, fabric)
        )

    assert abs(size(40) - size(2)) < 0.01 * size(2)  # numbers in the text have more digits
