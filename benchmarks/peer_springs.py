"""A cloth of masses and springs with explicit steps, in JAX: what a peer of its kind does.

The model of DaXBench and many others, written for this benchmark: structural springs along the
grid's lines, shear springs along both diagonals of every cell, soft bending springs between
vertices two apart; semi-implicit Euler; gradients by `jax.grad`, with one checkpoint a frame.

On a grid of squares such springs are a membrane with C11 = structural + shear and
C12 = C33 = shear, where `shear` is the constant of a diagonal. So they can be the membrane of
"hang", whose Poisson's ratio is 1/3, and no other.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scenes
from jaxtyping import Array, Float

import r2s
from r2s.units import GRAVITY

SHEAR = scenes.MEMBRANE[1]  # [N/m]
STRUCTURAL = scenes.MEMBRANE[0] - SHEAR  # [N/m]
BENDING = 0.01  # [N/m]: about the energy of 1e-5 N m at a radius of 0.1 m, on cells of 1/8 m
SPRINGS = {  # offsets (row, column) between the ends
    "structural": ((1, 0), (0, 1)),
    "shear": ((1, 1), (1, -1)),
    "bending": ((2, 0), (0, 2)),
}

Grid = Float[Array, "row column 3"]


def _between(x: Grid, offset: tuple[int, int]) -> Grid:
    """From every vertex to that at an offset, where there is one."""
    (rows, columns), (i, j) = x.shape[:2], offset
    first = x[: rows - i, max(0, -j) : columns - max(0, j)]
    return x[i:, max(0, j) : columns + min(0, j)] - first


def _spread(force: Grid, shape: tuple[int, ...], offset: tuple[int, int]) -> Grid:
    """The transpose of `_between`, negated: a pull [N] on both ends of every spring."""
    i, j = offset
    before, after = max(0, -j), max(0, j)
    first = jnp.pad(force, ((0, i), (before, after), (0, 0)))
    second = jnp.pad(force, ((i, 0), (after, before), (0, 0)))
    return first - second


def _share(size: int, offset: tuple[int, int]) -> np.ndarray:
    """How much of a spring there is [-]: half of a structural one on the sheet's boundary."""
    share = np.ones((size - offset[0], size - abs(offset[1]), 1))
    if offset == (1, 0):
        share[:, [0, -1]] = 0.5
    if offset == (0, 1):
        share[[0, -1]] = 0.5
    return share


def _force(x: Grid, v: Grid, stiffness: dict, damping: float) -> Grid:
    """Of all springs, [N]; `damping` [s] times the stiffness is their viscosity."""
    size, total = x.shape[0], jnp.zeros_like(x)
    for kind, offsets in SPRINGS.items():
        for offset in offsets:
            rest = scenes.SIDE / (size - 1) * float(np.hypot(*offset))
            span, rate = _between(x, offset), _between(v, offset)
            length = jnp.sqrt(jnp.sum(span**2, axis=-1, keepdims=True))
            along = span / length
            closing = jnp.sum(rate * along, axis=-1, keepdims=True)
            tension = stiffness[kind] * (length - rest + damping * closing)
            total += _spread(_share(size, offset) * tension * along, x.shape, offset)
    return total


def _simulate(parameters: dict, mesh: r2s.Mesh, substeps: int, damping: float) -> scenes.Motion:
    """The motion of "hang"; `parameters`: areal density [kg/m^2], stiffness of springs [N/m]."""
    dt, size = 1 / (60 * substeps), math.isqrt(len(mesh.rest))
    mass = parameters["density"] * mesh.vertex_area.reshape(size, size, 1)
    is_free = jnp.ones((size, size, 1)).at[0, jnp.array([0, -1])].set(0)
    weight = jnp.array([0.0, 0.0, -GRAVITY])

    def step(state, _):
        x, v = state
        v = is_free * (v + dt * (_force(x, v, parameters, damping) / mass + weight))
        return (x + dt * v, v), None

    @jax.checkpoint
    def frame(state, _):
        state, _ = jax.lax.scan(step, state, None, length=substeps)
        return state, state[0].reshape(-1, 3)

    x = scenes.flat(mesh).reshape(size, size, 3)
    return jax.lax.scan(frame, (x, jnp.zeros_like(x)), None, length=scenes.FRAMES)[1]


def _parameters(stiffness: float) -> dict:
    numbers = {
        "density": scenes.DENSITY,
        "structural": stiffness * STRUCTURAL,
        "shear": stiffness * SHEAR,
        "bending": BENDING,
    }
    return {name: jnp.asarray(number) for name, number in numbers.items()}


def forward(size: int, substeps: int, damping: float):
    """As `ours.forward`."""
    simulate = partial(_simulate, mesh=scenes.sheet(size), substeps=substeps, damping=damping)
    run = jax.jit(simulate).lower(_parameters(1.0)).compile()
    return lambda stiffness=1.0: np.asarray(run(_parameters(stiffness)))


def gradient(size: int, substeps: int, damping: float):
    """As `ours.gradient`, in areal density and the stiffness of the springs."""
    arguments = _parameters(1.0)
    mesh = scenes.sheet(size)
    start = scenes.flat(mesh)

    def loss(parameters):
        return scenes.loss(_simulate(parameters, mesh, substeps, damping), start)

    run = jax.jit(jax.value_and_grad(loss)).lower(arguments).compile()

    def call():
        value, slope = jax.block_until_ready(run(arguments))
        return float(value), sum(float(slope[k] * arguments[k]) for k in ("structural", "shear"))

    return call
