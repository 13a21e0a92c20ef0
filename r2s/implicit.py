"""A minimiser with an implicit derivative: the numerics of a step, apart from its physics."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from r2s.increment import Increment, hessian, imbalance, potential
from r2s.linear.factor import Factor, factor, solve
from r2s.linear.pattern import pinned

Positions = Float[Array, "vertex 3"]
CONVEX_ITERATIONS = 3  # before the exact Hessian is tried
SLOW = 0.6  # a step that is longer than this much of the one before calls for the exact Hessian,
STALE = 0.6  # and longer than this much for new factors
SHORTEST, LONGEST = 1e-6, 64.0  # fractions of a Newton step that are tried
SAVED = "positions"  # what a checkpointed rollout keeps of a step


class _Search(NamedTuple):
    x: Positions
    moved: Float[Array, ""]  # the last change, [m]
    factors: tuple[Factor, ...]
    is_stale: Bool[Array, ""]  # whether the next step needs new factors
    exactness: Float[Array, ""]  # of the Hessian that they are to be of
    limit: Float[Array, ""]  # exactness at which it may be indefinite
    count: Array


def minimise(
    increment: Increment,
    start: Positions,
    free: Bool[Array, " vertex"],
    tolerance: float,
    max_iterations: int,
) -> Positions:
    """Positions [m] that minimise an increment's potential over the `free` vertices.

    Newton's method (a convex stand-in for the Hessian, then the exact one; a factor serves as long
    as the steps shrink fast), until no coordinate changes by more than `tolerance` [m]. Its
    derivative, forward and reverse, is that of the exact minimum (implicit function theorem, with
    the exact Hessian), so it is right as far as the iteration converged; NaN when `max_iterations`
    did not suffice.
    """
    return _minimise(tolerance, max_iterations, increment, start, free)


def _newton(tolerance, max_iterations, increment, start, free):
    levels = increment.levels

    def iterate(state: _Search) -> _Search:
        force = _masked(imbalance(increment, state.x), free)
        renew = lambda: _search_factors(increment, state, free)
        factors = jax.lax.cond(state.is_stale, renew, lambda: state.factors)
        direction = -solve(levels, factors, force)
        usable = jnp.all(jnp.isfinite(direction))  # an indefinite Hessian has NaN for factors
        direction = jnp.where(usable, direction, 0)
        length, found = _line_search(increment, state.x, direction, force)
        full = jnp.max(jnp.abs(direction))
        # a search that found nothing has not arrived, however little it moved
        moved = jnp.where(found, length * full, full)
        moved = jnp.where(usable | (state.exactness == 0), moved, state.moved)
        is_slow = (moved > SLOW * state.moved) & (state.count >= CONVEX_ITERATIONS)
        exactness = jnp.where(is_slow, (state.exactness + state.limit) / 2, state.exactness)
        return _Search(
            x=state.x + length * direction,
            moved=moved,
            factors=factors,
            is_stale=~usable | (length != 1) | (moved > STALE * state.moved),
            exactness=jnp.where(usable, jnp.minimum(exactness, 1), state.exactness / 2),
            limit=jnp.where(usable, jnp.minimum(1.2 * state.limit, 2), state.exactness),
            count=state.count + 1,
        )

    def unfinished(state: _Search):
        return (state.moved > tolerance) & (state.count < max_iterations)

    zero, true = jnp.zeros((), int), jnp.ones((), bool)
    infinite = jnp.full((), jnp.inf, start.dtype)
    shapes = jax.eval_shape(lambda: factor(levels, hessian(increment, start)))
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    none = jnp.zeros((), start.dtype)
    begin = _Search(start, infinite, blank, true, none, none + 2, zero)
    found = jax.lax.while_loop(unfinished, iterate, begin)
    # a NaN compares false, so that it ends the loop and fails here
    return jnp.where(found.moved <= tolerance, found.x, jnp.nan)


def _search_factors(increment, state, free):
    """Factors of the exact Hessian or of the convex stand-in, at the place of a search."""
    blocks = hessian(increment, state.x, state.exactness)
    return factor(increment.levels, pinned(increment.pattern, blocks, free))


def _line_search(increment, x, direction, force):
    """How much of a direction to go [-], and whether there is a length that will do.

    The first of 1, 1/2, 1/4, ... that lowers the potential enough (Armijo) and ends short of where
    it would rise as steeply as it fell; the second test is for the last Newton steps, whose gain
    rounding hides. If that is 1, the last of 1, 2, 4, ... up to which the potential falls steeply:
    away from a shape that is about to buckle the convex stand-in is far too cautious.
    """
    before, slope = potential(increment, x), jnp.sum(direction * force)
    rounding = 8 * jnp.finfo(x.dtype).eps * jnp.abs(before)

    def look(length):
        # held vertices have no direction, so that their force does not count
        after, ahead = jax.value_and_grad(potential, argnums=1)(increment, x + length * direction)
        enough = after <= before + 1e-4 * length * slope + rounding
        ahead = jnp.sum(direction * ahead)
        return enough & (ahead <= -0.5 * slope), enough & (ahead < 0.5 * slope)

    def unfinished(state):
        length, (is_fine, is_steep), grows = state
        return jnp.where(grows, is_steep & (length < LONGEST), ~is_fine & (length > SHORTEST))

    def go_on(state):
        length, _, grows = state
        length = jnp.where(grows, 2 * length, length / 2)
        return length, look(length), grows

    one = jnp.ones((), x.dtype)
    first = look(one)
    length, (is_fine, is_steep), grows = jax.lax.while_loop(
        unfinished, go_on, (one, first, first[1])
    )
    length = jnp.where(grows & ~is_fine, length / 2, length)
    return length, length > SHORTEST


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
    # linear in the right-hand side, so that it batches and transposes with the same factors
    factors = _one_by_one(_exact_factors)(increment, x, free)
    return x, held_dot - solve(increment.levels, factors, _masked(force_dot, free))


def _exact_factors(increment, x, free):
    blocks = pinned(increment.pattern, hessian(increment, x), free)
    # where a shape is about to buckle the minimum may be found as a saddle: not definite
    return factor(increment.levels, blocks, is_definite=False)


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
        outputs = jax.lax.map(single, moving) if _on_cpu() else jax.vmap(single)(moving)
        return outputs, jax.tree.map(lambda _: True, outputs)

    return call


def _on_cpu():
    return jax.default_backend() == "cpu"


def _masked(force: Positions, free: Bool[Array, " vertex"]) -> Positions:
    return jnp.where(free[:, None], force, 0)
