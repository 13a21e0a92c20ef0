"""A minimiser with an implicit derivative: the numerics of a step, apart from its physics."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from r2s.cloth.linear.system import System, apply_inverse, prepare
from r2s.cloth.potential import IncrementalPotential, far, hessian, potential, residual

Positions = Float[Array, "vertex 3"]
CONVEX_ITERATIONS = 3  # before the exact Hessian is tried
SLOW = 0.6  # a step that is longer than this much of the one before calls for the exact Hessian,
STALE = 0.6  # and longer than this much for new factors
SHORTEST, LONGEST = 1e-6, 64.0  # fractions of a Newton step that are tried
SAVED = "positions"  # what a checkpointed rollout keeps of a step


class _Search(NamedTuple):
    x: Positions
    value: Float[Array, ""]  # of the potential, [J]
    force: Positions  # its derivative, [N]
    moved: Float[Array, ""]  # the last change, [m]
    system: System
    is_stale: Bool[Array, ""]  # whether the next step needs new factors
    exactness: Float[Array, ""]  # of the Hessian that they are to be of
    limit: Float[Array, ""]  # exactness at which it may be indefinite
    count: Array


def minimise(
    increment: IncrementalPotential,
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
    levels, pattern = increment.levels, increment.pattern

    def evaluate(x):
        value, force = jax.value_and_grad(potential, argnums=1)(increment, x)
        return value, _masked(force, free)

    def iterate(state: _Search) -> _Search:
        second = lambda: _second(increment, state.x, state.exactness)
        renew = lambda: prepare(levels, pattern, *second(), free)
        system = jax.lax.cond(state.is_stale, renew, lambda: state.system)
        direction = -apply_inverse(levels, pattern, system, state.force)
        slope = jnp.sum(direction * state.force)
        usable = slope <= 0  # an indefinite Hessian has NaN for factors
        direction = jnp.where(usable, direction, 0)
        length, value, force = _line_search(evaluate, state, direction, slope)
        found = length > 0
        full = jnp.max(jnp.abs(direction))
        # a search that found nothing has not arrived
        moved = jnp.where(found, length * full, full)
        moved = jnp.where(usable | (state.exactness == 0), moved, state.moved)
        is_slow = (moved > SLOW * state.moved) & (state.count >= CONVEX_ITERATIONS)
        exactness = jnp.where(is_slow, (state.exactness + state.limit) / 2, state.exactness)
        return _Search(
            x=state.x + length * direction,
            value=value,
            force=force,
            moved=moved,
            system=system,
            is_stale=~usable | (length != 1) | (moved > STALE * state.moved),
            exactness=jnp.where(usable, jnp.minimum(exactness, 1), state.exactness / 2),
            limit=jnp.where(usable, jnp.minimum(1.2 * state.limit, 2), state.exactness),
            count=state.count + 1,
        )

    def unfinished(state: _Search):
        goes_on = (state.moved > tolerance) & (state.count < max_iterations)
        return goes_on & jnp.isfinite(state.value)

    zero, true = jnp.zeros((), int), jnp.ones((), bool)
    infinite = jnp.full((), jnp.inf, start.dtype)
    shapes = jax.eval_shape(lambda: prepare(levels, pattern, *_second(increment, start), free))
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    none = jnp.zeros((), start.dtype)
    value, force = evaluate(start)
    begin = _Search(
        x=start,
        value=value,
        force=force,
        moved=infinite,
        system=blank,
        is_stale=true,
        exactness=none,
        limit=none + 2,
        count=zero,
    )
    found = jax.lax.while_loop(unfinished, iterate, begin)
    # a NaN compares false, so that it ends the loop and fails here
    return jnp.where((found.moved <= tolerance) & jnp.isfinite(found.value), found.x, jnp.nan)


def _second(increment, x, exactness: Array | float = 1.0):
    """The second derivative [N/m] of the potential, or its convex stand-in."""
    return hessian(increment, x, exactness), far(increment, x)


class _Length(NamedTuple):
    trial: Float[Array, ""]  # the next length to look at
    length: Float[Array, ""]  # the best so far; 0: none
    value: Float[Array, ""]  # potential [J] and force [N] there
    force: Positions
    goes_on: Bool[Array, ""]


def _line_search(evaluate, state: _Search, direction, slope):
    """How much of a direction to go [-], 0 if no length will do; potential and force there.

    The first of 1, 1/2, 1/4, ... that lowers the potential enough (Armijo) and ends short of where
    it would rise as steeply as it fell; the second test is for the last Newton steps, whose gain
    rounding hides. If that is 1, the last of 1, 2, 4, ... up to which the potential falls steeply:
    away from a shape that is about to buckle the convex stand-in is far too cautious.
    """
    rounding = 8 * jnp.finfo(direction.dtype).eps * jnp.abs(state.value)

    def look(at: _Length) -> _Length:
        value, force = evaluate(state.x + at.trial * direction)
        ahead = jnp.sum(direction * force)
        enough = value <= state.value + 1e-4 * at.trial * slope + rounding
        is_fine = enough & (ahead <= -0.5 * slope)
        is_steep = enough & (ahead < 0.5 * slope)
        grows = is_steep & (at.trial >= 1) & (at.trial < LONGEST)
        shrinks = ~is_fine & (at.trial <= 1) & (at.trial > SHORTEST)
        best = lambda new, old: jnp.where(is_fine, new, old)
        return _Length(
            trial=jnp.where(grows, 2 * at.trial, at.trial / 2),
            length=best(at.trial, at.length),
            value=best(value, at.value),
            force=best(force, at.force),
            goes_on=grows | shrinks,
        )

    one, true = jnp.ones((), direction.dtype), jnp.ones((), bool)
    begin = _Length(one, 0 * one, state.value, state.force, true)
    found = jax.lax.while_loop(lambda at: at.goes_on, look, begin)
    return found.length, found.value, found.force


@eqx.filter_custom_jvp
def _minimise(tolerance, max_iterations, increment, start, free):
    return _one_by_one(partial(_newton, tolerance, max_iterations))(increment, start, free)


@_minimise.def_jvp
def _minimise_jvp(primals, tangents):
    _, _, increment, start, free = primals
    _, _, increment_dot, start_dot, _ = tangents
    x = checkpoint_name(_minimise(*primals), SAVED)
    held_dot = jnp.zeros_like(x) if start_dot is None else jnp.where(free[:, None], 0, start_dot)
    _, force_dot = eqx.filter_jvp(residual, (increment, x), (increment_dot, held_dot))
    # linear in the right-hand side, so that it batches and transposes with the same factors
    system = _one_by_one(_exact_system)(increment, x, free)
    about = increment.levels, increment.pattern, system
    return x, held_dot - apply_inverse(*about, _masked(force_dot, free), is_definite=False)


def _exact_system(increment, x, free):
    about = increment.levels, increment.pattern
    # where a shape is about to buckle the minimum may be found as a saddle: not definite
    return prepare(*about, *_second(increment, x), free, is_definite=False)


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
