"""A solid body of particles, in 2-D or 3-D, by the material point method.

MLS-MPM (Hu et al. 2018) with APIC, explicit in time (symplectic Euler), as in DiffTaichi and
DiffCP.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.environment.scene import Control
from r2s.materials.solid import Solid, product
from r2s.solvers.explicit.stability import check_step, longest_step
from r2s.solvers.mpm.background import Background, Pinned
from r2s.solvers.mpm.grid import failure_of_step
from r2s.solvers.mpm.transfer import affine_factor
from r2s.solvers.results import first_failure, no_failure

Points = Float[Array, "particle axis"]


class BlockState(eqx.Module):
    """The particles of a block at one time.

    - `x`, `v`: positions [m] and velocities [m/s].
    - `C`: affine velocity matrices, [1/s].
    - `F`: deformation gradients, [-].
    - `failure`: the first `r2s.solvers.results.Result` of the run so far.
    """

    x: Float[Array, "particle axis"]
    v: Float[Array, "particle axis"]
    C: Float[Array, "particle axis axis"]
    F: Float[Array, "particle axis axis"]
    failure: Int[Array, ""]


class Block(eqx.Module):
    """A body in its surroundings, stepped explicitly.

    It is differentiable in solid, state, control and background; in forward mode when the
    background allows it.

    - `background`: grid, table, walls, gravity.
    - `volume`: volumes of the particles at rest, [m^3]; in 2-D of a body of 1 m depth.
    - `pinned`, `gripper_of`: the particles that grippers carry, and the gripper that carries each.
    - `offset`: positions of the pinned particles relative to their grippers, [m].
    - `dt`: step, [s].
    """

    background: Background
    volume: Float[Array, " particle"]
    pinned: Int[Array, " pinned"]
    gripper_of: Int[Array, " pinned"]
    offset: Float[Array, "pinned axis"]
    dt: float = eqx.field(static=True)

    @classmethod
    def make(
        cls, background: Background, volume: Float[Array, " particle"], solid: Solid, dt: float
    ) -> "Block":
        """A solver in steps `dt` [s] for particles of `volume` [m^3] at rest that no gripper holds.

        `solid`: the stiffest material that the solver will be used for. Raises `ValueError` when
        the step is too long for it; the text gives the limit.
        """
        if not dt > 0:
            raise ValueError(f"dt must be positive, got {dt} s")
        none, offset = jnp.zeros(0, int), jnp.zeros((0, len(background.grid.shape)), float)
        solver = cls(background, jnp.asarray(volume, float), none, none, offset, float(dt))
        solver.check(solid)
        return solver

    def gripped(self, x: Points, grippers: Float[Array, "gripper axis"], radius: float) -> "Block":
        """The solver with grippers that carry the particles within `radius` [m] of the grippers.

        `x` and `grippers` are the positions [m] of particles and grippers when the grippers close.
        Raises `ValueError` when a gripper finds no particle.
        """
        distance = np.linalg.norm(np.asarray(x)[:, None] - np.asarray(grippers)[None], axis=2)
        nearest = np.argmin(distance, axis=1)
        pinned = np.flatnonzero(np.min(distance, axis=1) <= radius)
        empty = np.setdiff1d(np.arange(len(grippers)), nearest[pinned])
        if len(empty):
            raise ValueError(
                f"gripper {empty[0]} finds no particle within {radius} m: the nearest is "
                f"{distance[:, empty[0]].min():.4g} m away"
            )
        gripper_of = nearest[pinned]
        offset = jnp.asarray(x)[pinned] - jnp.asarray(grippers)[gripper_of]
        parts = (jnp.asarray(pinned), jnp.asarray(gripper_of), offset)
        return eqx.tree_at(lambda s: (s.pinned, s.gripper_of, s.offset), self, parts)

    def check(self, solid: Solid) -> None:
        """Raises `ValueError` when the step is too long for a solid, unless that is traced."""
        with jax.ensure_compile_time_eval():
            longest = stable_step(self.background, solid)
        check_step(self.dt, longest, "the solid and the grid")

    def fits(self, solid: Solid) -> Bool[Array, ""]:
        """Not judged where a solid is traced."""
        return jnp.ones((), bool)

    def init(self, x: Points, v: Points | None = None) -> BlockState:
        """A state of no strain from positions [m] and velocities [m/s] (default: zero).

        Raises `ValueError` when a particle is outside the grid, unless positions are traced.
        """
        x = jnp.asarray(x, self.volume.dtype)
        self.background.grid.check(x)
        v = jnp.zeros_like(x) if v is None else jnp.asarray(v, x.dtype)
        if v.shape != x.shape or len(x) != len(self.volume):
            raise ValueError(f"{len(self.volume)} places and velocities, got {x.shape}, {v.shape}")
        identity = jnp.broadcast_to(jnp.eye(x.shape[1], dtype=x.dtype), (*x.shape, x.shape[1]))
        return BlockState(x, v, jnp.zeros_like(identity), identity, no_failure())

    def step(self, fabric: Solid, state: BlockState, control: Control) -> BlockState:
        """The state `dt` later, its pinned particles at `control.pinned` plus their offsets."""
        dt, pinned = self.dt, self.pinned
        deformation = state.F + dt * jax.vmap(product)(state.C, state.F)
        mass = fabric.density * self.volume
        goal = control.pinned[self.gripper_of] + self.offset
        carried = Pinned(state.x[pinned], (goal - state.x[pinned]) / dt, mass[pinned])
        v = _put(state.v, pinned, carried.v)
        momentum = mass[:, None] * (1 - dt * fabric.mass_damping) * v
        stress = jax.vmap(fabric.law.kirchhoff)(deformation)
        stress += fabric.damping * jax.vmap(fabric.law.viscous)(state.C)
        factor = -dt * affine_factor(self.background.grid) * self.volume
        affine = factor[:, None, None] * stress + mass[:, None, None] * state.C
        v, C = self.background.advance(
            dt, fabric.friction, state.x, mass, momentum, affine, carried
        )
        v, C = _put(v, pinned, carried.v), _put(C, pinned, jnp.zeros_like(C[pinned]))
        x = _put(state.x + dt * v, pinned, goal)
        failure = failure_of_step(self.background.grid, state.x, x, (fabric, control))
        failure = first_failure(state.failure, failure)
        return BlockState(self.background.project(x), v, C, deformation, failure)


def _put(values: Array, where: Array, pinned: Array) -> Array:
    """Values with those of the pinned particles replaced."""
    return values.at[where].set(pinned) if where.shape[0] else values


def stable_step(background: Background, solid: Solid) -> Float[Array, ""]:
    """The longest step [s] that is stable for a solid of small strain on a grid.

    On quadratic B-splines sum w d^2 = spacing^2 / 4, so that the stiffness of a particle over its
    share of the nodes' masses is at most 4 modulus / (density spacing^2). That bounds the square of
    every frequency of the grid, as for finite elements (Fried 1972).
    """
    grid = background.grid
    square = 4 * solid.law.modulus(len(grid.shape)) / (solid.density * grid.spacing**2)
    return longest_step([(square, solid.damping)])
