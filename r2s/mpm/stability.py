"""How long a step may be, and why a motion failed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from r2s.failures import Failure
from r2s.mpm.grid import Grid
from r2s.units import Scalar

SAFETY = 0.7  # of the limit at rest: what is stretched or compressed is stiffer

Points = Float[Array, "particle axis"]


def longest_step(squares: list[tuple[Scalar, Scalar]]) -> Float[Array, ""]:
    """The longest step [s] for parts with a highest frequency and a damping time.

    `squares` are pairs of frequency squared [1/s^2] and stiffness-proportional damping time [s].
    Symplectic Euler with the damping of the step's start needs, for every frequency w,
    dt^2 w^2 + 2 dt damping w^2 <= 4. The result is `SAFETY` times that limit.
    """
    stiff = sum(square for square, _ in squares)
    damped = sum(square * time for square, time in squares)
    return SAFETY * 4 / (damped + jnp.sqrt(damped**2 + 4 * jnp.asarray(stiff, float)))


def check_step(dt: float, longest: Float[Array, ""], material: str) -> None:
    """Raises `ValueError` when a step [s] is longer than the longest, unless that is traced."""
    if isinstance(longest, Tracer):
        return
    limit = float(np.min(np.asarray(longest)))
    if not dt <= limit:
        raise ValueError(
            f"the step is limited by {material} to {limit:.4g} s, got dt = {dt:.4g} s: take a "
            "shorter step, a coarser grid, a softer or heavier material, or less damping"
        )


def failure_of_step(grid: Grid, before: Points, after: Points, inputs: Any) -> Int[Array, ""]:
    """The `r2s.failures.Failure` of one step.

    - `before`: positions at the start of the step, [m].
    - `after`: positions at its end, also of particles that have left the grid, [m].
    - `inputs`: what else the step depends on, such as fabric and control.

    Inputs that are not finite give `NON_FINITE`. A result that is not finite gives `TIME_STEP`, and
    so does a particle that leaves the grid while one moves by more than a spacing in the step, as
    only an unstable step throws it. Any other particle outside the grid gives `GRID`.
    """
    outside = ~jnp.all(grid.inside(after))
    thrown = jnp.any(jnp.abs(after - before) > grid.spacing)
    unstable = ~_all_finite(after) | (outside & thrown)
    code = jnp.where(outside, Failure.GRID.value, Failure.NONE.value)
    code = jnp.where(unstable, Failure.TIME_STEP.value, code)
    return jnp.where(_all_finite((before, inputs)), code, Failure.NON_FINITE.value)


def _all_finite(tree: Any) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))
