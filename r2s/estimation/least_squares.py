"""Nonlinear least squares within bounds, with a normal prior.

    solver = BoundedGaussNewton(rtol=1e-5, atol=1e-5, low=0.0, high=1.0)
    optimistix.least_squares(residual, solver, y0).value

The solvers of optimistix have neither bounds nor a prior. `proposed` and `damped` are one step of
this one, for callers that have normal equations instead of residuals; `bounded_step` is the exact
minimum of a quadratic within bounds.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree
from scipy import optimize

DAMPINGS = (1e-3, 1e6)
INITIAL_DAMPING, GROWTH = 1e-2, 3.0
ROUNDING = 1e-12  # of the largest curvature: less is none


class Damping(eqx.Module):
    """Levenberg's damping.

    - `value`: relative to the diagonal of the matrix, [-].
    - `growth`: factor if the next step fails (Nielsen 1999).
    """

    value: Float[Array, "*batch"]
    growth: Float[Array, "*batch"]

    @staticmethod
    def initial(dtype: Any = float) -> "Damping":
        return Damping(jnp.asarray(INITIAL_DAMPING, dtype), jnp.asarray(GROWTH, dtype))


def at_bound(
    y: Float[Array, " y"], gradient: Float[Array, " y"], low: Array, high: Array
) -> Bool[Array, " y"]:
    """Which entries are at a bound beyond which the objective would fall."""
    return ((y <= low) & (gradient > 0)) | ((y >= high) & (gradient < 0))


def newton_step(
    gradient: Float[Array, " y"], matrix: Float[Array, "y y"], fixed: Bool[Array, " y"]
) -> Float[Array, " y"]:
    """The Gauss-Newton step of the entries not `fixed`; zero in directions without curvature."""
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
    """The next trial: a damped Gauss-Newton step within bounds.

    Entries held by a bound stay, and the others take the step alone. A step with an entry longer
    than its `longest` is shortened as a whole.
    """
    fixed = at_bound(y, gradient, low, high)
    damped_matrix = matrix + damping.value * jnp.diag(jnp.diag(matrix))
    change = newton_step(gradient, damped_matrix, fixed)
    change = change / jnp.maximum(1, jnp.max(jnp.abs(change) / longest))
    return jnp.clip(y + change, low, high)


def damped(damping: Damping, is_better: Bool[Array, ""]) -> Damping:
    """The damping after a step: a quarter after a success, else multiplied by its growth."""
    value = jnp.where(is_better, damping.value / 4, damping.value * damping.growth)
    growth = jnp.where(is_better, GROWTH, 2 * damping.growth)
    return Damping(jnp.clip(value, *DAMPINGS), growth)


def bounded_step(
    gradient: Float[np.ndarray, " y"],
    matrix: Float[np.ndarray, "y y"],
    limits: tuple[Float[np.ndarray, " y"], Float[np.ndarray, " y"]],
) -> Float[np.ndarray, " y"]:
    """The step x within limits that minimises gradient x + x matrix x / 2; NaN if these are not
    finite. The matrix is positive up to rounding."""
    if not (np.isfinite(gradient).all() and np.isfinite(matrix).all()):
        return np.full(len(gradient), np.nan)
    sizes, axes = np.linalg.eigh(np.asarray(matrix, np.float64))
    roots = np.sqrt(np.maximum(np.abs(sizes), ROUNDING * np.abs(sizes).max()))
    right = -axes.T @ np.asarray(gradient, np.float64) / roots
    return optimize.lsq_linear(roots[:, None] * axes.T, right, limits, method="bvls").x


def common_axes(
    one: Float[np.ndarray, "y y"], other: Float[np.ndarray, "y y"]
) -> tuple[Float[np.ndarray, " y"], Float[np.ndarray, "y y"]]:
    """Sizes s and axes A in which two positive matrices have no correlation: one = A A^T,
    other = A diag(s) A^T."""
    root = np.linalg.cholesky(one)
    sizes, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, other).T))
    return sizes, root @ axes


class _State(eqx.Module):
    loss: Float[Array, ""]
    gradient: Float[Array, " y"]
    matrix: Float[Array, "y y"]
    damping: Damping
    change: Float[Array, " y"]
    gain: Float[Array, ""]
    is_better: Bool[Array, ""]
    aux: Any


class BoundedGaussNewton(optimistix.AbstractLeastSquaresSolver):
    """Minimises half the sum of squares of a residual and of (y - mean) precision (y - mean),
    within bounds.

    - `rtol`, `atol`: it ends when a step changes y and the objective by no more than these.
    - `low`, `high`: bounds of y. `mean`, `precision`: its prior, or None.

    y is a vector. A trial whose residual is not finite is rejected. If that of the start is not, or
    no step is short enough, the result is not successful. The derivative is forward
    (`jax.linearize`).
    """

    rtol: float
    atol: float
    low: Float[ArrayLike, "#y"] | float = -jnp.inf
    high: Float[ArrayLike, "#y"] | float = jnp.inf
    mean: Float[Array, " y"] | None = None
    precision: Float[Array, "y y"] | None = None
    norm: Callable[[PyTree], Array] = optimistix.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        zero = jnp.zeros_like(y)
        return _State(
            loss=jnp.asarray(jnp.inf, y.dtype),
            gradient=zero,
            matrix=jnp.eye(len(y), dtype=y.dtype),
            damping=Damping.initial(y.dtype),
            change=zero,
            gain=jnp.asarray(jnp.inf, y.dtype),
            is_better=jnp.asarray(False),
            aux=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        low, high = (
            jnp.broadcast_to(jnp.asarray(bound), y.shape).astype(y.dtype)
            for bound in (self.low, self.high)
        )
        # the gradient of `init` is zero: the first trial is the start
        trial = proposed(y, state.gradient, state.matrix, state.damping, low, high)
        value, slope, aux = jax.linearize(lambda at: fn(at, args), trial, has_aux=True)
        slope = jax.vmap(slope, out_axes=1)(jnp.eye(len(trial), dtype=trial.dtype))
        loss, gradient, matrix = value @ value / 2, slope.T @ value, slope.T @ slope
        if self.precision is not None:
            off = trial if self.mean is None else trial - self.mean
            pull = self.precision @ off
            loss, gradient = loss + off @ pull / 2, gradient + pull
            matrix = matrix + self.precision
        is_finite = jnp.isfinite(loss) & jnp.all(jnp.isfinite(matrix))
        is_better = is_finite & (loss < state.loss)

        def choose(new, old):
            return jax.tree.map(lambda a, b: jnp.where(is_better, a, b), new, old)

        after = _State(
            loss=choose(loss, state.loss),
            gradient=choose(gradient, state.gradient),
            matrix=choose(matrix, state.matrix),
            damping=damped(state.damping, is_better),
            change=trial - y,
            gain=state.loss - loss,
            is_better=is_better,
            aux=choose(aux, state.aux),
        )
        return choose(trial, y), after, after.aux

    def terminate(self, fn, y, args, options, state: _State, tags):
        small = jnp.all(jnp.abs(state.change) <= self.atol + self.rtol * jnp.abs(y))
        little = jnp.abs(state.gain) <= self.atol + self.rtol * jnp.abs(state.loss)
        has_begun = jnp.isfinite(state.loss)
        # a rejected step so short that rounding decides is an end, too
        is_done = has_begun & small & (little | ~state.is_better)
        has_failed = ~has_begun & (state.damping.growth > GROWTH)  # at the start
        has_no_step = (state.damping.value >= DAMPINGS[1]) | has_failed
        is_stuck = ~state.is_better & has_no_step & ~is_done
        result = optimistix.RESULTS.where(
            is_stuck, optimistix.RESULTS.nonlinear_divergence, optimistix.RESULTS.successful
        )
        return is_done | is_stuck, result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        return y, aux, {"loss": state.loss, "matrix": state.matrix}
