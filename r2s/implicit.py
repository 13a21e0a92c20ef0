"""A minimiser with an implicit derivative: the numerics of a step, apart from its physics."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from r2s.increment import Increment, convex_hessian, hessian, imbalance, potential

Positions = Float[Array, "vertex 3"]
CONVEX_ITERATIONS = 4  # of Newton, before it tries the exact Hessian
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

    Newton's method (a convex stand-in for the Hessian, then the exact one), until no coordinate
    changes by more than `tolerance` [m]. Its derivative, forward and reverse, is that of the exact
    minimum (implicit function theorem, with the exact Hessian), so it is right as far as the
    iteration converged; NaN when `max_iterations` did not suffice.
    """
    return _minimise(tolerance, max_iterations, increment, start, free)


def _newton(tolerance, max_iterations, increment, start, free):
    def iterate(state: _Search) -> _Search:
        force = _masked(imbalance(increment, state.x), free)
        direction = _direction(increment, state, force, free)
        length = _line_search(increment, state.x, direction, force)
        moved = length * jnp.max(jnp.abs(direction))
        return _Search(state.x + length * direction, moved, state.count + 1)

    def unfinished(state: _Search):
        return (state.moved > tolerance) & (state.count < max_iterations)

    infinite = jnp.full((), jnp.inf, start.dtype)
    found = jax.lax.while_loop(unfinished, iterate, _Search(start, infinite, jnp.zeros((), int)))
    # a NaN compares false, so that it ends the loop and fails here
    return jnp.where(found.moved <= tolerance, found.x, jnp.nan)


def _direction(increment, state, force, free):
    """A Newton direction [m]: with the exact Hessian where it is positive definite.

    The convex stand-in is cheaper and gets close from afar; next to a buckling shape it converges
    slowly, and the exact one quadratically.
    """

    def solve(matrix):
        factor = jax.scipy.linalg.cho_factor(_pinned(matrix, free))
        return -jax.scipy.linalg.cho_solve(factor, force.ravel()).reshape(force.shape)

    def convex():
        return solve(convex_hessian(increment, state.x))

    def exact():
        direction = solve(hessian(increment, state.x))
        usable = jnp.all(jnp.isfinite(direction))  # the Cholesky factor of an indefinite one is NaN
        return jax.lax.cond(usable, lambda: direction, convex)

    return jax.lax.cond(state.count < CONVEX_ITERATIONS, convex, exact)


def _line_search(increment, x, direction, force):
    """The first of 1, 1/2, 1/4, ... that lowers the potential enough (Armijo) and ends short of
    where it would rise as steeply as it fell.

    The second test is for the last Newton steps, whose gain rounding hides.
    """
    before, slope = potential(increment, x), jnp.sum(direction * force)
    rounding = 8 * jnp.finfo(x.dtype).eps * jnp.abs(before)

    def too_long(length):
        # held vertices have no direction, so that their force does not count
        after, ahead = jax.value_and_grad(potential, argnums=1)(increment, x + length * direction)
        enough = after <= before + 1e-4 * length * slope + rounding
        overshot = jnp.sum(direction * ahead) > -0.5 * slope
        return (~enough | overshot) & (length > 1e-6)

    return jax.lax.while_loop(too_long, lambda length: length / 2, jnp.ones((), x.dtype))


@eqx.filter_custom_jvp
def _minimise(tolerance, max_iterations, increment, start, free):
    return _one_by_one(partial(_newton, tolerance, max_iterations))(increment, start, free)


@_minimise.def_jvp
def _minimise_jvp(primals, tangents):
    _, _, increment, start, free = primals
    _, _, increment_dot, start_dot, _ = tangents
    x = checkpoint_name(_minimise(*primals), SAVED)
    held_dot = jnp.zeros_like(x) if start_dot is None else jnp.where(free[:, None], 0, start_dot)
    _, force_dot = eqx.filter_jvp(imbalance, (increment, x), (increment_dot, held_dot))
    # an explicit inverse, since its product batches and transposes without another factorisation
    free_dot = -_one_by_one(_inverse)(increment, x, free) @ _masked(force_dot, free).ravel()
    return x, held_dot + free_dot.reshape(x.shape)


def _inverse(increment, x, free):
    return jnp.linalg.inv(_pinned(hessian(increment, x), free))


def _one_by_one(function):
    """`function`, which under `vmap` on a CPU runs for one member of the batch after the other.

    So no member waits for the slowest, and the factors fit the cache. Nor is there a gain from a
    batch there; and jaxlib 0.10.1 for the CPU can hang in a batched factorisation inside a loop.
    """

    @jax.custom_batching.custom_vmap
    def call(*args):
        return function(*args)

    @call.def_vmap
    def batched(size, is_batched, *args):
        moving, still = eqx.partition(args, tuple(is_batched))
        single = lambda moving: function(*eqx.combine(moving, still))
        if jax.default_backend() == "cpu":
            return jax.lax.map(single, moving), True
        return jax.vmap(single)(moving), True

    return call


def _masked(force: Positions, free: Bool[Array, " vertex"]) -> Positions:
    return jnp.where(free[:, None], force, 0)


def _pinned(matrix: Array, free: Bool[Array, " vertex"]) -> Array:
    """The matrix with rows and columns of held coordinates replaced by those of the identity."""
    coordinate = jnp.repeat(free, 3)
    both = coordinate[:, None] & coordinate[None, :]
    return jnp.where(both, matrix, jnp.diag(jnp.where(coordinate, 0, 1).astype(matrix.dtype)))
