"""Why a motion failed."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r2s.solvers.failures import Failure, all_finite
from r2s.solvers.mpm.grid import Grid

Points = Float[Array, "particle axis"]


def failure_of_step(grid: Grid, before: Points, after: Points, inputs: Any) -> Int[Array, ""]:
    """The `r2s.solvers.failures.Failure` of one step.

    - `before`: positions at the start of the step, [m].
    - `after`: positions at its end, also of particles that have left the grid, [m].
    - `inputs`: what else the step depends on, such as fabric and control.

    Inputs that are not finite give `NON_FINITE`. A result that is not finite gives `TIME_STEP`, and
    so does a particle that leaves the grid while one moves by more than a spacing in the step, as
    only an unstable step throws it. Any other particle outside the grid gives `GRID`.
    """
    outside = ~jnp.all(grid.inside(after))
    thrown = jnp.any(jnp.abs(after - before) > grid.spacing)
    unstable = ~all_finite(after) | (outside & thrown)
    code = jnp.where(outside, Failure.GRID.value, Failure.NONE.value)
    code = jnp.where(unstable, Failure.TIME_STEP.value, code)
    return jnp.where(all_finite((before, inputs)), code, Failure.NON_FINITE.value)
