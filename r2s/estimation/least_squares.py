"""Nonlinear least squares within bounds, with a normal prior: damped Gauss-Newton steps.

`proposed` and `damped` are one step of the Levenberg-Marquardt method, from normal equations that a
caller has made. `r2s.estimation.bounded_gauss_newton` makes them of a residual.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

DAMPINGS = (1e-3, 1e6)
INITIAL_DAMPING, GROWTH = 1e-2, 3.0


class Damping(eqx.Module):
    """- `value`: Levenberg's, times the diagonal of the matrix, [-].
    - `growth`: its factor should the next step fail (Nielsen 1999).
    """

    value: Float[Array, "*batch"]
    growth: Float[Array, "*batch"]

    @staticmethod
    def initial(dtype: Any = float) -> "Damping":
        return Damping(jnp.asarray(INITIAL_DAMPING, dtype), jnp.asarray(GROWTH, dtype))


def at_bound(
    y: Float[Array, " y"], gradient: Float[Array, " y"], low: Array, high: Array
) -> Bool[Array, " y"]:
    """What is at a bound, beyond which the objective would fall."""
    return ((y <= low) & (gradient > 0)) | ((y >= high) & (gradient < 0))


def newton_step(
    gradient: Float[Array, " y"], matrix: Float[Array, "y y"], fixed: Bool[Array, " y"]
) -> Float[Array, " y"]:
    """The Gauss-Newton step, without what is fixed; none in a direction without curvature."""
    matrix = jnp.where(fixed[:, None] | fixed[None], jnp.diag(jnp.diag(matrix)), matrix)
    size = jnp.sqrt(jnp.diag(matrix))
    size = jnp.where(size > 0, size, 1)
    unit = matrix / jnp.outer(size, size)
    unit = unit + 4 * len(size) * jnp.finfo(unit.dtype).eps * jnp.eye(len(size), dtype=unit.dtype)
    return -jnp.linalg.solve(unit, jnp.where(fixed, 0, gradient) / size) / size


def proposed(
    y: Float[Array, " y"],
    gradient: Float[Array, " y"],
    matrix: Float[Array, "y y"],
    damping: Damping,
    low: Float[Array, "#y"],
    high: Float[Array, "#y"],
    longest: Float[Array, "#y"] | float = jnp.inf,
) -> Float[Array, " y"]:
    """The next place to try: a damped Gauss-Newton step within bounds.

    What is at a bound that it would leave stays there, and the others take the step alone. A step
    in which one is longer than its `longest` is shortened to that as a whole.
    """
    fixed = at_bound(y, gradient, low, high)
    damped_matrix = matrix + damping.value * jnp.diag(jnp.diag(matrix))
    change = newton_step(gradient, damped_matrix, fixed)
    change = change / jnp.maximum(1, jnp.max(jnp.abs(change) / longest))
    return jnp.clip(y + change, low, high)


def damped(damping: Damping, is_better: Bool[Array, ""]) -> Damping:
    """The damping after a step: a quarter where that was better, else more by its growth."""
    value = jnp.where(is_better, damping.value / 4, damping.value * damping.growth)
    growth = jnp.where(is_better, GROWTH, 2 * damping.growth)
    return Damping(jnp.clip(value, *DAMPINGS), growth)
