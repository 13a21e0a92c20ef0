"""Material points of r2s: an elastic block in 2-D, as Taichi has it, too.

8,192 random particles in a unit box of 128 x 128 nodes, neo-Hookean, in the units of DiffTaichi,
are thrown and torn, so that they are under stress (MLS-MPM, quadratic B-splines, APIC, float32).
"""

import _measure
import jax
import jax.numpy as jnp
import numpy as np

import r2s
from r2s.materials.solid import NeoHookean, Solid
from r2s.solvers.mpm import Background, Block, Grid

MU, LAMBDA, MASS, VOLUME, GRAVITY, WALLS = 100.0, 100.0, 1.0, 1.0, 9.8, 3  # units of DiffTaichi
COUNT, NODES, DT = 8192, 128, 1e-4
FRAMES = 32  # the states that reverse mode keeps


def start_of_block() -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of the particles."""
    x = np.random.default_rng(0).uniform(0.3, 0.6, (COUNT, 2)).astype(np.float32)
    v = np.array((1.5, -2.0)) + 5 * (x - x.mean(axis=0)) * (1, -1)
    return x, v.astype(np.float32)


def block_loss(steps: int):
    """The mean square of all positions at the end, by the stiffness mu, and mu itself."""
    grid = Grid((0.0, 0.0), 1 / NODES, (NODES, NODES))
    background = Background(grid, gravity=GRAVITY, walls=WALLS)

    def material(mu):
        return Solid.make(NeoHookean(mu, jnp.asarray(LAMBDA, float)), MASS)

    mu = jnp.asarray(MU, float)
    solver = Block.make(background, jnp.full(COUNT, VOLUME), material(mu), DT)
    start = solver.init(*map(jnp.asarray, start_of_block()))
    control, every = r2s.Control(jnp.zeros((steps, 0, 2))), steps // FRAMES

    def loss(mu):
        moved = r2s.simulate(solver, material(mu), start, control, save_every=every)
        return jnp.mean(moved.final_state.x**2)

    return loss, mu


def compiled(function, stiffness):
    """A call without arguments, and the memory [MB] that its program takes."""
    run = jax.jit(function).lower(stiffness).compile()
    return lambda: jax.block_until_ready(run(stiffness)), _measure.memory(run)
