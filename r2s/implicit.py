"""A minimiser with an implicit derivative: the numerics of a step, apart from its physics."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from r2s.increment import Increment, convex_hessian, hessian, imbalance

Positions = Float[Array, "vertex 3"]
SAVED = "positions"  # what a checkpointed rollout keeps of a step


class _Search(NamedTuple):
    x: Positions
    moved: Float[Array, ""]  # the last change, [m]
    count: Array


def minimise(
    increment: Increment,
    start: Positions,
    free: Bool[Array, " vertex"],
    tolerance: float,
    max_iterations: int,
) -> Positions:
    """Positions [m] that minimise an increment's potential over the `free` vertices.

    Newton's method on a convex stand-in for the Hessian, with a line search, until no coordinate
    changes by more than `tolerance` [m]. Its derivative, forward and reverse, is that of the exact
    minimum (implicit function theorem, with the exact Hessian), so it is right as far as the
    iteration converged; NaN when `max_iterations` did not suffice.
    """
    return _minimise(tolerance, max_iterations, increment, start, free)


def _newton(tolerance, max_iterations, increment, start, free):
    def iterate(state: _Search) -> _Search:
        force = _masked(imbalance(increment, state.x), free)
        matrix = _pinned(convex_hessian(increment, state.x), free)
        factor = jax.scipy.linalg.cho_factor(matrix)
        direction = -jax.scipy.linalg.cho_solve(factor, force.ravel()).reshape(start.shape)
        length = _line_search(increment, state.x, direction, -jnp.sum(direction * force), free)
        moved = length * jnp.max(jnp.abs(direction))
        return _Search(state.x + length * direction, moved, state.count + 1)

    def unfinished(state: _Search):
        return (state.moved > tolerance) & (state.count < max_iterations)

    infinite = jnp.full((), jnp.inf, start.dtype)
    found = jax.lax.while_loop(unfinished, iterate, _Search(start, infinite, jnp.zeros((), int)))
    # a NaN compares false, so that it ends the loop and fails here
    return jnp.where(found.moved <= tolerance, found.x, jnp.nan)


def _line_search(increment, x, direction, descent, free):
    """The largest of 1, 1/2, 1/4, ... at which the slope along `direction` has not overshot.

    On slopes, not on energies: in float32 the energy's rounding hides the last Newton steps.
    """

    def slope(length):
        return jnp.sum(direction * _masked(imbalance(increment, x + length * direction), free))

    def too_long(length):
        return (slope(length) > 0.9 * descent) & (length > 1e-3)

    return jax.lax.while_loop(too_long, lambda length: length / 2, jnp.ones((), x.dtype))


@eqx.filter_custom_jvp
def _minimise(tolerance, max_iterations, increment, start, free):
    return _newton(tolerance, max_iterations, increment, start, free)


@_minimise.def_jvp
def _minimise_jvp(primals, tangents):
    tolerance, max_iterations, increment, start, free = primals
    _, _, increment_dot, start_dot, _ = tangents
    x = checkpoint_name(_newton(tolerance, max_iterations, increment, start, free), SAVED)
    held_dot = jnp.zeros_like(x) if start_dot is None else jnp.where(free[:, None], 0, start_dot)

    _, force_dot = eqx.filter_jvp(imbalance, (increment, x), (increment_dot, held_dot))
    matrix = _pinned(hessian(increment, x), free)
    factor = jax.scipy.linalg.lu_factor(matrix)
    free_dot = -jax.scipy.linalg.lu_solve(factor, _masked(force_dot, free).ravel())
    return x, held_dot + free_dot.reshape(x.shape)


def _masked(force: Positions, free: Bool[Array, " vertex"]) -> Positions:
    return jnp.where(free[:, None], force, 0)


def _pinned(matrix: Array, free: Bool[Array, " vertex"]) -> Array:
    """The matrix with rows and columns of held coordinates replaced by those of the identity."""
    coordinate = jnp.repeat(free, 3)
    both = coordinate[:, None] & coordinate[None, :]
    return jnp.where(both, matrix, jnp.diag(jnp.where(coordinate, 0, 1).astype(matrix.dtype)))
