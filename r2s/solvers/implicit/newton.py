"""Newton's method with an implicit derivative: the numerics of a step, apart from its physics."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from r2s.materials.wrinkling import no_wrinkles
from r2s.solvers.implicit.potential import (
    IncrementalPotential,
    far_couplings,
    find_wrinkles,
    hessian,
    potential,
    residual,
)
from r2s.solvers.implicit.system import System, apply_inverse, prepare, raise_diagonal
from r2s.solvers.results import Result

Positions = Float[Array, "vertex 3"]
CONVEX_ITERATIONS = 3  # before the exact Hessian is tried
SLOW = 0.6  # a step that is longer than this much of the one before calls for the exact Hessian,
STALE = 0.6  # and longer than this much for new factors
FIRST_SHIFT, LAST_SHIFT = 10, 1e-2  # of the diagonal: in units of its rounding; at most
LEAST_BLEND = 1e-3  # of the exact Hessian: below it the convex stand-in is tried alone
SHORTEST, LONGEST = 1e-6, 64.0  # fractions of a Newton step that are tried
ROUNDING, NOISE = 8, 1000  # of a potential, in units of its last place: usual, and at most
SAVED = "positions"  # what a checkpointed rollout keeps of a step


class _Point(NamedTuple):
    x: Positions
    value: Float[Array, ""]  # of the potential, [J]
    force: Positions  # its derivative, [N]
    wrinkles: Any  # that were found there


class _Line(NamedTuple):
    direction: Positions
    slope: Float[Array, ""]  # of the potential at its start, [J]
    full: Float[Array, ""]  # the most that a coordinate changes in its length, [m]
    usable: Bool[Array, ""]
    trial: Float[Array, ""]  # the next length to look at
    length: Float[Array, ""]  # the best so far; 0: none
    best: _Point  # there


class _Search(NamedTuple):
    at: _Point
    line: _Line  # from there
    searching: Bool[Array, ""]  # whether the line search has not ended
    moved: Float[Array, ""]  # the last change, [m]
    system: System
    is_stale: Bool[Array, ""]  # whether the next step needs new factors
    blend: Float[Array, ""]  # share of the exact Hessian in them
    limit: Float[Array, ""]  # blend at which it may be indefinite
    shift: Float[Array, ""]  # share of the diagonal that is added, where rounding spoils factors
    count: Array  # of steps made; -1 before the start was looked at


def minimise(
    step: IncrementalPotential,
    start: Positions,
    free: Bool[Array, " vertex"],
    tolerance: Float[Array, ""] | float,
    max_iterations: int,
) -> tuple[Positions, Int[Array, ""]]:
    """Positions [m] that minimise an incremental potential, and a `Result` code.

    Newton's method, with a convex stand-in for the Hessian at first, then with more and more of the
    exact one. A factor serves as long as the steps shrink fast. The derivative, forward and
    reverse, is that of the exact minimum (implicit function theorem, with the exact Hessian), so it
    is right as far as the iteration converged. Positions are NaN where it failed.

    - `start`: where to begin, [m]; vertices that are not `free` stay there.
    - `tolerance`: it has converged when no coordinate changes by more, [m].
    - `max_iterations`: after which it has failed.
    """
    x, code = _minimise(max_iterations, jnp.asarray(tolerance, start.dtype), step, start, free)
    return x, jax.lax.stop_gradient(code).astype(int)


def _newton(max_iterations, tolerance, step, start, free):
    # one loop over all trial points: each function is in the program once
    def look(state: _Search) -> _Search:
        state = jax.lax.cond(state.searching, lambda: state, lambda: _turned(step, free, state))
        near = state.at.wrinkles
        point = _look(step, free, state.at.x + state.line.trial * state.line.direction, near)
        line, searching = _judged(state.at, state.line, point)
        return _moved(state, line, searching)

    def unfinished(state: _Search):
        # a raised diagonal shortens steps: what is short with one may be far from the minimum
        is_raised = state.shift > FIRST_SHIFT * jnp.finfo(state.shift.dtype).eps
        more = ((state.moved > tolerance) | is_raised) & (state.count < max_iterations)
        more &= jnp.isfinite(state.at.value) & ~jnp.isnan(state.moved)
        return state.searching | more

    end = jax.lax.while_loop(unfinished, look, _begin(step, start, free))
    # a NaN compares false, so that it never counts as convergence
    reason = jnp.where(jnp.isnan(end.moved), Result.LINEAR_SOLVE.value, Result.NEWTON.value)
    is_finite = jnp.isfinite(end.at.value)
    reason = jnp.where(is_finite, reason, Result.NON_FINITE.value)
    converged = (end.moved <= tolerance) & is_finite
    code = jnp.where(converged, Result.SUCCESS.value, reason)
    return jnp.where(converged, end.at.x, jnp.nan), code.astype(start.dtype)


def _begin(step, start, free) -> _Search:
    """A line without length: to look at the start."""
    zero, yes = jnp.zeros((), start.dtype), jnp.ones((), bool)
    infinite, wrinkles = zero + jnp.inf, no_wrinkles(step.membrane)
    shapes = jax.eval_shape(
        lambda: prepare(step.elimination, *_second(step, start, zero, zero, wrinkles), free)
    )
    at = _Point(start, infinite, jnp.zeros_like(start), wrinkles)
    return _Search(
        at=at,
        line=_Line(jnp.zeros_like(start), zero, infinite, yes, zero + 1, zero, at),
        searching=yes,
        moved=infinite,
        system=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
        is_stale=yes,
        blend=zero,
        limit=zero + 2,
        shift=zero,
        count=jnp.full((), -1, int),
    )


def _look(step, free, x: Positions, near: Any) -> _Point:
    wrinkles = find_wrinkles(step, x, near)
    value, force = jax.value_and_grad(potential, argnums=1)(step, x, wrinkles)
    return _Point(x, value, jnp.where(free[:, None], force, 0), wrinkles)


def _turned(step, free, state: _Search) -> _Search:
    """The search with the line of the next Newton step."""
    system = jax.lax.cond(
        state.is_stale,
        lambda: prepare(
            step.elimination,
            *_second(step, state.at.x, state.blend, state.shift, state.at.wrinkles),
            free,
        ),
        lambda: state.system,
    )
    direction = -apply_inverse(step.elimination, system, state.at.force)
    slope = jnp.sum(direction * state.at.force)
    usable = slope <= 0  # an indefinite Hessian has NaN for factors
    full = jnp.max(jnp.abs(direction))
    one = jnp.ones((), direction.dtype)
    line = _Line(jnp.where(usable, direction, 0), slope, full, usable, one, 0 * one, state.at)
    return state._replace(system=system, line=line, searching=jnp.ones((), bool))


def _judged(at: _Point, line: _Line, point: _Point) -> tuple[_Line, Bool[Array, ""]]:
    """A line search after a trial point, and whether it has not ended.

    It takes the first of 1, 1/2, 1/4, ... that lowers the potential enough (Armijo) and ends short
    of where it would rise as steeply as it fell. Where rounding hides the gain it is enough that
    the slope is half of what it was (Hager and Zhang 2005). If that is 1, it takes the last of 1,
    2, 4, ... up to which the potential falls steeply: away from a shape that is about to buckle the
    convex stand-in is far too cautious.
    """
    last_place = jnp.finfo(point.value.dtype).eps * jnp.abs(at.value)
    ahead = jnp.sum(line.direction * point.force)
    gain = point.value - at.value
    enough = gain <= 1e-4 * line.trial * line.slope + ROUNDING * last_place
    enough |= (gain <= NOISE * last_place) & (jnp.abs(ahead) <= -0.5 * line.slope)
    is_fine = enough & (ahead <= -0.5 * line.slope)
    is_steep = enough & (ahead < 0.5 * line.slope)
    grows = is_steep & (line.trial >= 1) & (line.trial < LONGEST)
    shrinks = ~is_fine & (line.trial <= 1) & (line.trial > SHORTEST)
    line = line._replace(
        trial=jnp.where(grows, 2 * line.trial, line.trial / 2),
        length=jnp.where(is_fine, line.trial, line.length),
        best=jax.tree.map(partial(jnp.where, is_fine), point, line.best),
    )
    return line, (grows | shrinks) & line.usable


def _moved(state: _Search, line: _Line, searching: Bool[Array, ""]) -> _Search:
    """The search after a trial point: at the end of its line once that is known."""
    usable, is_first = line.usable, state.count < 0
    # a search that found nothing has not arrived
    moved = jnp.where(line.length > 0, line.length * line.full, line.full)
    # where even the convex stand-in gives no direction it is NaN, and the loop ends
    is_indefinite = (state.blend == 0) & (state.shift > LAST_SHIFT)
    moved = jnp.where(usable, moved, jnp.where(is_indefinite, line.full, state.moved))
    is_slow = (moved > SLOW * state.moved) & (state.count >= CONVEX_ITERATIONS)
    blend = jnp.where(is_slow, (state.blend + state.limit) / 2, state.blend)
    # where the Hessian is indefinite: half of the exact one, or none; the stand-in is only rounded
    less = jnp.where(state.blend > LEAST_BLEND, state.blend / 2, 0)
    limit = jnp.where(state.blend > 0, state.blend, state.limit)
    # more of the diagonal where rounding made the convex stand-in indefinite, else less
    least = FIRST_SHIFT * jnp.finfo(state.shift.dtype).eps
    higher = jnp.where(state.blend == 0, jnp.maximum(4 * state.shift, least), state.shift)
    lower = jnp.where(state.shift > least, state.shift / 2, 0)
    arrived = state._replace(
        at=line.best,
        moved=moved,
        is_stale=is_first | ~usable | (line.length != 1) | (moved > STALE * state.moved),
        blend=jnp.where(usable, jnp.minimum(blend, 1), less),
        limit=jnp.where(usable, jnp.minimum(1.2 * state.limit, 2), limit),
        shift=jnp.where(usable, lower, higher),
        count=state.count + 1,
    )
    # the factors stay where they are: a choice between them would copy them
    new, old = (search._replace(system=None, line=None) for search in (arrived, state))
    chosen = jax.tree.map(lambda a, b: jnp.where(searching, b, a), new, old)
    return chosen._replace(system=state.system, line=line, searching=searching)


def _second(step, x, blend: Array | float = 1.0, shift: Array | float = 0.0, wrinkles: Any = None):
    """The second derivative [N/m] of the potential, or its convex stand-in, its diagonal raised."""
    blocks = raise_diagonal(step.elimination.pattern, hessian(step, x, blend, wrinkles), shift)
    return blocks, far_couplings(step, x)


@eqx.filter_custom_jvp
def _minimise(max_iterations, tolerance, step, start, free):
    return _one_by_one(partial(_newton, max_iterations))(tolerance, step, start, free)


@_minimise.def_jvp
def _minimise_jvp(primals, tangents):
    _, _, step, start, free = primals
    _, _, step_dot, start_dot, _ = tangents
    x, code = checkpoint_name(_minimise(*primals), SAVED)
    held_dot = jnp.zeros_like(x) if start_dot is None else jnp.where(free[:, None], 0, start_dot)
    _, force_dot = eqx.filter_jvp(residual, (step, x), (step_dot, held_dot))

    def exact(step, x, free):
        # where a shape is about to buckle the minimum may be a saddle: not definite
        return prepare(step.elimination, *_second(step, x), free, is_definite=False)

    # linear in the right-hand side, so that it batches and transposes with the same factors
    system = _one_by_one(exact)(step, x, free)
    right = jnp.where(free[:, None], force_dot, 0)
    x_dot = held_dot - apply_inverse(step.elimination, system, right, is_definite=False)
    return (x, code), (x_dot, jnp.zeros_like(code))


def _one_by_one(function):
    """`function`, which under `vmap` on a CPU runs for one member of the batch after the other.

    So no member waits for the slowest, and the factors fit the cache. And jaxlib 0.10.1 for the
    CPU can hang in a batched factorisation inside a loop.
    """

    @jax.custom_batching.custom_vmap
    def call(*args):
        return function(*args)

    @call.def_vmap
    def batched(size, is_batched, *args):
        moving, still = eqx.partition(args, tuple(is_batched))

        def single(moving):
            return function(*eqx.combine(moving, still))

        on_cpu = jax.default_backend() == "cpu"
        outputs = jax.lax.map(single, moving) if on_cpu else jax.vmap(single)(moving)
        return outputs, jax.tree.map(lambda _: True, outputs)

    return call
