"""What the tests of the material point method share: small bodies, and how to run them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r2s.environment.scene import Control
from r2s.materials.solid import FixedCorotated, Solid
from r2s.solvers.mpm import Background, Block, Grid


def lattice(lower, upper, spacing):
    """Particles [m] at the middles of cells of a spacing [m] between two corners, and volumes."""
    counts = [round((b - a) / spacing) for a, b in zip(lower, upper, strict=True)]
    axes = [a + spacing * (np.arange(count) + 0.5) for a, count in zip(lower, counts, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lower))
    return jnp.asarray(x), jnp.full(len(x), spacing ** len(lower))


def solid(young=1e4, poisson=0.3, density=1e3, law=FixedCorotated, **others):
    return Solid.make(law.make(young, poisson), density, **others)


def box(dimension: int, cells: int = 16, **options) -> Background:
    """A unit box with a spacing of 1 / `cells` [m], and free space around it."""
    grid = Grid.covering((0.0,) * dimension, (1.0,) * dimension, 1 / cells)
    return Background(grid, **options)


def still(steps: int, dimension: int = 3, grippers: int = 0) -> Control:
    """The control of some steps without wind, and with grippers at the origin."""
    return Control(jnp.zeros((steps, grippers, dimension)))


@eqx.filter_jit
def states(solver, fabric, state, control):
    """The states at the end of every step, with a leading axis of time."""

    def step(state, control):
        state = solver.step(fabric, state, control)
        return state, state

    return jax.lax.scan(step, state, control)[1]


def spin(matrices):
    """Twice the axial vectors of matrices (time, particle, axis, axis), or their one component."""
    if matrices.shape[-1] == 2:
        return matrices[..., 1, 0] - matrices[..., 0, 1]
    parts = [matrices[..., j, i] - matrices[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.stack(parts, axis=-1)


def momenta(states, mass, spacing):
    """Linear [kg m/s] and angular momentum [kg m^2/s] of states with a leading axis of time.

    With the angular momentum that APIC keeps in the affine velocity, mass spacing^2 / 4 C.
    """
    x, v, C = (np.asarray(part) for part in (states.x, states.v, states.C))
    mass = np.asarray(mass)[None, :, None]
    tensors = mass[..., None] * (v[..., :, None] * x[..., None, :] + spacing**2 / 4 * C)
    return np.sum(mass * v, axis=1), np.sum(spin(tensors), axis=1)


def small_block(dimension, dt=1e-3, material=None, **options):
    """A cube of 0.25 m in the middle of a box; solver, material and positions."""
    material = solid() if material is None else material
    background = box(dimension, 8, **options)
    x, volume = lattice((0.375,) * dimension, (0.625,) * dimension, 1 / 16)
    return Block.make(background, volume, material, dt), material, x
