"""Nonlinear least squares within bounds, with a normal prior, as a solver of optimistix.

    solver = BoundedGaussNewton(rtol=1e-5, atol=1e-5, low=0.0, high=1.0)
    optimistix.least_squares(residual, solver, y0).value

Optimistix's own solvers know no bounds and no prior. Its steps are those of
`r2s.estimation.least_squares`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from r2s.estimation.least_squares import DAMPINGS, GROWTH, Damping, damped, proposed


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
    """Least half the sum of squares of a residual and of (y - mean) precision (y - mean), within
    bounds.

    - `rtol`, `atol`: it ends when a step changes y and the objective by no more than these.
    - `low`, `high`: bounds of y, numbers or as y is.
    - `mean`, `precision`: of the prior of y as one vector (`jax.flatten_util.ravel_pytree`); None:
      there is none.

    A place where the residual is not finite is as bad as can be: the next step is shorter. Where y
    is so at the beginning, or no step is short enough, the result is not successful. The derivative
    is forward (`jax.linearize`), once for each entry of y.
    """

    rtol: float
    atol: float
    low: PyTree = -jnp.inf
    high: PyTree = jnp.inf
    mean: Float[Array, " y"] | None = None
    precision: Float[Array, "y y"] | None = None
    norm: Callable[[PyTree], Array] = optimistix.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        flat, _ = ravel_pytree(y)
        zero = jnp.zeros_like(flat)
        aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct)
        return _State(
            loss=jnp.asarray(jnp.inf, flat.dtype),
            gradient=zero,
            matrix=jnp.eye(len(flat), dtype=flat.dtype),
            damping=Damping.initial(flat.dtype),
            change=zero,
            gain=jnp.asarray(jnp.inf, flat.dtype),
            is_better=jnp.asarray(False),
            aux=aux,
        )

    def step(self, fn, y, args, options, state: _State, tags):
        flat, unravel = ravel_pytree(y)
        low, high = (_like(bound, y, flat) for bound in (self.low, self.high))
        # without a gradient yet, the first is where it begins
        trial = proposed(flat, state.gradient, state.matrix, state.damping, low, high)

        def residual(at):
            value, aux = fn(unravel(at), args)
            return ravel_pytree(value)[0], aux

        value, slope, aux = jax.linearize(residual, trial, has_aux=True)
        slope = jax.vmap(slope, out_axes=1)(jnp.eye(len(trial), dtype=trial.dtype))
        loss, gradient, matrix = value @ value / 2, slope.T @ value, slope.T @ slope
        if self.precision is not None:
            off = trial if self.mean is None else trial - self.mean
            pull = self.precision @ off
            loss, gradient = loss + off @ pull / 2, gradient + pull
            matrix = matrix + self.precision
        is_finite = jnp.isfinite(loss) & jnp.all(jnp.isfinite(matrix))
        is_better = is_finite & (loss < state.loss)
        change, gain = trial - flat, state.loss - loss

        def choose(new, old):
            return jax.tree.map(lambda a, b: jnp.where(is_better, a, b), new, old)

        after = _State(
            loss=choose(loss, state.loss),
            gradient=choose(gradient, state.gradient),
            matrix=choose(matrix, state.matrix),
            damping=damped(state.damping, is_better),
            change=change,
            gain=gain,
            is_better=is_better,
            aux=choose(aux, state.aux),
        )
        return unravel(choose(trial, flat)), after, after.aux

    def terminate(self, fn, y, args, options, state: _State, tags):
        flat, _ = ravel_pytree(y)
        small = jnp.all(jnp.abs(state.change) <= self.atol + self.rtol * jnp.abs(flat))
        little = jnp.abs(state.gain) <= self.atol + self.rtol * jnp.abs(state.loss)
        has_begun = jnp.isfinite(state.loss)
        # a step so short that rounding decides whether it gains is an end, too
        is_done = has_begun & small & (little | ~state.is_better)
        has_failed = ~has_begun & (state.damping.growth > GROWTH)  # where it begins
        has_no_step = (state.damping.value >= DAMPINGS[1]) | has_failed
        is_stuck = ~state.is_better & has_no_step & ~is_done
        result = optimistix.RESULTS.where(
            is_stuck, optimistix.RESULTS.nonlinear_divergence, optimistix.RESULTS.successful
        )
        return is_done | is_stuck, result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        return y, aux, {"loss": state.loss, "matrix": state.matrix}


def _like(bound: PyTree, y: PyTree, flat: Float[Array, " y"]) -> Float[Array, " y"]:
    """Bounds of each entry of y, from numbers or a tree like y."""
    whole = jax.tree.structure(bound) == jax.tree.structure(y)
    tree = bound if whole else jax.tree.map(lambda _: bound, y)
    full = jax.tree.map(lambda b, part: jnp.broadcast_to(jnp.asarray(b), part.shape), tree, y)
    return ravel_pytree(full)[0].astype(flat.dtype)
