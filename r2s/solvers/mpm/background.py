"""The grid that particles move through, with gravity, table, walls and grippers at its nodes."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.arrays import as_floats
from r2s._util.units import GRAVITY
from r2s.environment.contact import SLIP_SPEED, Table
from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.transfer import affine_factor, g2p, g2p_plain, g2p_through, p2g, p2g_plain

Vectors = Float[Array, "particle axis"]
Matrices = Float[Array, "particle axis axis"]
Columns = list[Float[Array, "_ _"]]  # (1, node) or (node, 1)

GRIPPED = 0.25  # share of a node's mass; at the border of pinned and free particles it is a half


class Pinned(eqx.Module):
    """Positions [m], velocities [m/s] and masses [kg] of the particles that grippers carry."""

    x: Float[Array, "pinned axis"]
    v: Float[Array, "pinned axis"]
    mass: Float[Array, " pinned"]


class Background(eqx.Module):
    """A grid and what acts at its nodes. The last axis points up.

    - `grid`: the nodes, which limit where particles may be.
    - `table`: nodes at or below its height lose downward velocity; None: no table.
    - `gravity`: downward acceleration, [m/s^2].
    - `walls`: number of nodes at each end of an axis that lose outward velocity; 0: no walls.
    - `mass_floor`: mass added to every node, over the mean mass of a particle [-].
    - `forward_mode`: whether JAX derives the transfers itself, so that `jax.jvp` works; the own
      rules, which are the default, have a faster reverse mode.

    Raises `ValueError` for impossible walls or mass floor.
    """

    grid: Grid
    table: Table | None = None
    gravity: Float[Array, ""] = eqx.field(default=GRAVITY, converter=as_floats)
    walls: int = eqx.field(static=True, default=0)
    mass_floor: float = eqx.field(static=True, default=1e-15)
    forward_mode: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        least = min(self.grid.shape)
        if not 0 <= self.walls < least / 2 or self.mass_floor < 0:
            raise ValueError(
                f"walls must be from 0 to less than half of {least} nodes and the mass floor >= 0, "
                f"got {self.walls} and {self.mass_floor}"
            )

    def advance(
        self,
        dt: float,
        friction: Float[Array, ""],
        x: Vectors,
        mass: Float[Array, " particle"],
        momentum: Vectors,
        affine: Matrices,
        pinned: Pinned | None = None,
    ) -> tuple[Vectors, Matrices]:
        """Velocities [m/s] and affine velocity matrices [1/s] of particles after a step `dt` [s].

        - `friction`: Coulomb coefficient against the table, [-].
        - `x`, `mass`: positions [m] and masses [kg] at the start of the step.
        - `momentum`, `affine`: momenta [kg m/s] and affine momenta [kg/s], with what forces and
          stresses have added in the step.
        - `pinned`: particles that impose their velocity on the nodes around them.
        """
        with jax.named_scope("particles_to_grid"):
            still = jnp.zeros_like(affine[:, :1])
            values = jnp.concatenate([momentum, mass[:, None]], axis=1)
            slopes = jnp.concatenate([affine, still], axis=1)
            nodes = self._to_nodes(x, values, slopes)
        floor = self.mass_floor * jnp.mean(mass)
        grip = None if pinned is None or not pinned.x.shape[0] else pinned
        velocity = partial(self._velocity, dt, friction, floor, grip)
        if grip is None and 3 ** x.shape[1] * x.shape[0] < nodes.shape[0]:
            v, moment = g2p_through(self.grid, x, nodes, velocity, self.forward_mode)
            return v, affine_factor(self.grid) * moment
        with jax.named_scope("grid"):
            columns = jnp.split(nodes, nodes.shape[1], axis=1)
            v = jnp.concatenate(velocity(columns, self._index()), axis=1)
        with jax.named_scope("grid_to_particles"):
            get = g2p_plain if self.forward_mode else g2p
            v, moment = get(self.grid, x, v)
        return v, affine_factor(self.grid) * moment

    def _velocity(
        self,
        dt: float,
        friction: Array,
        floor: Array,
        pinned: Pinned | None,
        nodes: Columns,
        index: list[Array],
    ) -> Columns:
        """Velocities [m/s] of nodes from their momenta [kg m/s] and masses [kg], by axes."""
        *momentum, mass = nodes
        v = [quotient(part, mass + floor) for part in momentum]
        v[-1] = v[-1] - dt * self.gravity
        if pinned is not None:
            v = self._gripped(v, mass, floor, pinned)
        return self._walled(self._on_table(v, friction, index[-1]), index)

    def _to_nodes(self, x: Vectors, values: Array, slopes: Array) -> Array:
        return (p2g_plain if self.forward_mode else p2g)(self.grid, x, values, slopes)

    def _index(self) -> list[Array]:
        """Of each axis, the indices of all nodes, each (node, 1)."""
        shape, kind = self.grid.shape, jnp.asarray(0).dtype
        axes = range(len(shape))
        return [jax.lax.broadcasted_iota(kind, shape, axis).reshape(-1, 1) for axis in axes]

    def _gripped(self, v: Columns, mass: Array, floor: Array, pinned: Pinned) -> Columns:
        """Velocities that blend into the grippers' where up to `GRIPPED` of the mass is held.

        Beyond that share a node has the grippers' velocity: nodes that are held only in part would
        let the body creep out of the grip.
        """
        values = jnp.concatenate([pinned.mass[:, None] * pinned.v, pinned.mass[:, None]], axis=1)
        flat = jnp.zeros((*values.shape, pinned.x.shape[1]), values.dtype)
        nodes = self._to_nodes(pinned.x, values, flat)
        *carried, weight = jnp.split(nodes, nodes.shape[1], axis=1)
        share = jnp.minimum(quotient(weight, mass + floor) / GRIPPED, 1)
        grip = [quotient(part, weight + floor) for part in carried]
        return [u + share * (g - u) for u, g in zip(v, grip, strict=True)]

    def _on_table(self, v: Columns, friction: Float[Array, ""], index: Array) -> Columns:
        """Velocities [m/s] that do not point into the table and slide on it by Coulomb's law.

        The lost normal velocity times the friction coefficient bounds the lost sliding velocity.
        """
        if self.table is None:
            return v
        height = self.grid.lower[-1] + self.grid.spacing * index.astype(v[-1].dtype)
        below = height <= self.table.height + 1e-6 * self.grid.spacing
        *along, normal = v
        impulse = jnp.maximum(-normal, 0)
        speed = jnp.sqrt(sum(part**2 for part in along) + SLIP_SPEED**2)
        kept = jnp.maximum(1 - friction * impulse / speed, 0)
        slid = [jnp.where(below, kept * part, part) for part in along]
        return [*slid, jnp.where(below, jnp.maximum(normal, 0), normal)]

    def _walled(self, v: Columns, index: list[Array]) -> Columns:
        """Velocities [m/s] that do not point out through the walls."""
        if not self.walls:
            return v
        columns = []
        for part, place, count in zip(v, index, self.grid.shape, strict=True):
            low = jnp.where(place < self.walls, jnp.maximum(part, 0), part)
            columns.append(jnp.where(place > count - self.walls, jnp.minimum(low, 0), low))
        return columns

    def project(self, x: Vectors) -> Vectors:
        """Positions [m] lifted onto the table, and NaN where they are off the grid."""
        if self.table is not None:
            lowest = jnp.full(x.shape[1] - 1, -jnp.inf, x.dtype)
            x = jnp.maximum(x, jnp.append(lowest, self.table.height)[None])
        return jnp.where(self.grid.inside(x)[:, None], x, jnp.nan)


@jax.custom_jvp
def quotient(
    numerator: Float[Array, "_ _"], denominator: Float[Array, "_ _"]
) -> Float[Array, "_ _"]:
    """The ratio, with derivatives that do not square its denominator, which may be tiny.

    The cotangent of a node is as small as its mass, so that their ratio is safe in float32 too.
    """
    return numerator / denominator


@quotient.defjvp
def _quotient_jvp(primals, tangents):
    ratio = quotient(*primals)
    change, stretch = tangents
    return ratio, (change - ratio * stretch) / primals[1]
