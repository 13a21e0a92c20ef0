"""The grid of the material point method: its nodes, which particles are inside, and failures."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import as_floats
from r2s.solvers.results import Result, all_finite

REACH = 2  # nodes that a particle needs beyond it, on each side
MAX_NODES = 2**27  # about 2 GB in 3-D


class Grid(eqx.Module):
    """A grid of nodes in 2-D or 3-D. The last axis points up.

    - `lower`: position of the first node, [m].
    - `spacing`: distance between nodes, [m].
    - `shape`: number of nodes along each axis.

    Raises `ValueError` when it is not 2-D or 3-D, or has too few or too many nodes.
    """

    lower: Float[Array, " axis"] = eqx.field(converter=as_floats)
    spacing: float = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        lower, spacing, shape = self.lower, self.spacing, self.shape
        if len(shape) not in (2, 3) or len(lower) != len(shape):
            raise ValueError(f"a grid has 2 or 3 axes, got lower {lower} and shape {shape}")
        if not spacing > 0 or min(shape) < 2 * REACH or math.prod(shape) > MAX_NODES:
            raise ValueError(
                f"a grid needs a spacing > 0 m, at least {2 * REACH} nodes along each axis and at "
                f"most {MAX_NODES} in all, got {spacing} m and {shape}"
            )

    @classmethod
    def covering(
        cls, lower: tuple[float, ...], upper: tuple[float, ...], spacing: float, margin: int = 4
    ) -> "Grid":
        """The grid whose particles may be anywhere between two corners [m].

        `margin` nodes surround them. A node lies exactly at `lower`: a table there is met by nodes.
        """
        if not spacing > 0 or not all(a < b for a, b in zip(lower, upper, strict=True)):
            raise ValueError(
                f"a grid needs a spacing > 0 m and lower < upper, got {spacing}, {lower}, {upper}"
            )
        first = tuple(a - margin * spacing for a in lower)
        cells = [math.ceil((b - a) / spacing - 1e-9) for a, b in zip(lower, upper, strict=True)]
        return cls(first, spacing, tuple(count + 1 + 2 * margin for count in cells))

    @property
    def axes(self) -> tuple[Float[Array, " ..."], ...]:
        """The coordinates of the nodes [m] along each axis, ready to be broadcast to `shape`."""
        indices = jnp.ogrid[tuple(slice(count) for count in self.shape)]
        return tuple(
            low + self.spacing * index.astype(float)
            for low, index in zip(self.lower, indices, strict=True)
        )

    def inside(self, x: Float[Array, "particle axis"]) -> Bool[Array, " particle"]:
        """Whether the grid has all nodes that a particle at `x` [m] touches."""
        place = (x - self.lower[None]) / self.spacing
        last = jnp.asarray(self.shape, x.dtype)[None] - 1.5
        return jnp.all((place >= 0.5) & (place < last), axis=1)

    def check(self, x: Float[Array, "particle axis"]) -> None:
        """Raises `ValueError` when a particle at `x` [m] is not inside, unless `x` is traced."""
        if isinstance(x, Tracer) or isinstance(self.lower, Tracer):
            return
        with jax.ensure_compile_time_eval():
            outside = np.flatnonzero(~np.asarray(self.inside(x)))
        if len(outside):
            lower, shape = np.asarray(self.lower), np.asarray(self.shape)
            first = np.asarray(x)[outside[0]]
            low, high = lower + 0.5 * self.spacing, lower + (shape - 1.5) * self.spacing
            first, low, high = (np.round(place, 4).tolist() for place in (first, low, high))
            raise ValueError(
                f"{len(outside)} particles are outside the grid, the first at {first} m; they may "
                f"be from {low} to {high} m"
            )


Points = Float[Array, "particle axis"]


def failure_of_step(grid: Grid, before: Points, after: Points, inputs: Any) -> Int[Array, ""]:
    """The `r2s.solvers.results.Result` of one step, from positions [m] and its other inputs.

    Inputs that are not finite give `NON_FINITE`. A result that is not finite gives `TIME_STEP`, and
    so does a particle that leaves the grid while one moves by more than a spacing in the step, as
    only an unstable step throws it. Any other particle outside the grid gives `GRID`.
    """
    outside = ~jnp.all(grid.inside(after))
    thrown = jnp.any(jnp.abs(after - before) > grid.spacing)
    unstable = ~all_finite(after) | (outside & thrown)
    code = jnp.where(outside, Result.GRID.value, Result.SUCCESS.value)
    code = jnp.where(unstable, Result.TIME_STEP.value, code)
    return jnp.where(all_finite((before, inputs)), code, Result.NON_FINITE.value)
