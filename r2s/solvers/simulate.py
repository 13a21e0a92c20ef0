"""From steps to motions: `simulate`, for any solver with `init` and `step`."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.checks import check_kinds
from r2s._util.threads import planned
from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.solvers.implicit.newton import SAVED
from r2s.solvers.results import Result, describe, first_failure, no_failure

State = TypeVar("State")


@runtime_checkable
class Solver(Protocol[State]):
    """What `simulate` and the estimators need of a solver.

    Its fabric is an `r2s.Fabric`, or what else its bodies are made of. A state has positions `x`
    [m], velocities `v` [m/s] and a `failure`, the first `Result` of the run that is no success.
    """

    dt: Any  # [s], a number or an array without axes

    def step(self, fabric: Any, state: State, control: Control, /) -> State:
        """The state `dt` later."""
        ...

    def check(self, fabric: Any, /) -> None:
        """Raise `ValueError` where steps of `dt` are unstable for a fabric that is not traced."""

    def fits(self, fabric: Any, /) -> Bool[Array, ""]:
        """Whether steps of `dt` are stable for a fabric that may be traced, as far as is known."""
        ...


def predicted_memory(function: Callable, *args) -> int:
    """The memory [byte] that a jitted call of `function` on `args` will need, as compiled.

    That of arguments, results and intermediates, without a device's libraries. Nothing runs.

        predicted_memory(jax.value_and_grad(loss), fabric)
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    run = jax.jit(lambda arrays: eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array))
    return planned(run.lower(arrays).compile())


class Solution(eqx.Module):
    """A motion, where it ended, and whether it failed. Under `jax.vmap` all fields have a batch
    axis.

    - `x`, `v`: positions [m] and velocities [m/s] at the `times` [s] that are saved.
    - `final_state`: after the last step; `simulate` can start from it.
    - `ok`: of each saved time, whether all is finite and nothing has failed so far.
    - `result`: a `Result`; `Result.SUCCESS` is 0.
    - `failed_at`: the time [s] at the end of the step that failed first; NaN: none did.
    """

    x: Float[Array, "save vertex axis"]
    v: Float[Array, "save vertex axis"]
    times: Float[Array, " save"]
    final_state: Any
    ok: Bool[Array, " save"]
    result: Int[Array, ""]
    failed_at: Float[Array, ""]

    def explain(self) -> str:
        """One sentence: what failed, and when; empty when nothing did.

        It is that of one run; of a batch, pick a member first. Raises `ValueError` for a batch.
        """
        if self.result.ndim:
            raise ValueError(f"expected one run, got a batch of shape {self.result.shape}")
        if not int(self.result):
            return ""
        time = float(self.failed_at)  # of a scenario the first frame is at 0
        when = f"at {time:.4g} s" if time >= 0 else f"{-time:.4g} s before the first frame"
        return f"failed {when}: {describe(int(self.result))}"


def simulate(
    solver: Solver[State],
    fabric: Any,
    state: State,
    control: Control,
    *,
    save_every: int | None = None,
    save_at: Float[Array, " save"] | None = None,
    keep_solutions: bool = True,
    saves: Int[Array, ""] | int | None = None,
) -> Solution:
    """The motion from a state under a control of every step.

    - `control`: with a leading axis of steps; a `wind` without one stays.
    - `save_every`: steps between saved times; the first is at the end of so many. By default 1.
    - `save_at`: times [s] since `state`, instead: cubic in between by the positions and velocities
      at both ends of a step.
    - `keep_solutions`: reverse mode keeps one state a saved time, and of every step its solution.
      Without, it keeps the states alone and solves the steps between two of them again: the time
      of one more forward run, for the memory of about saves + steps between them.
    - `saves`: how many saved times are simulated, which may be traced; the others repeat the last.

    Raises `ValueError` for a fabric that is too stiff for the solver's steps (`Solver.check`); a
    run with a traced one fails in its first step (`Result.TIME_STEP`). And for steps that
    `save_every` does not divide, and times beyond the last step.
    """
    call = "simulate(solver, fabric, state, control)"
    check_kinds(call, control=(control, Control))
    if isinstance(solver, Fabric):
        raise TypeError(f"{call}: solver must be a solver, got Fabric")
    if not is_traced(solver, fabric):
        solver.check(fabric)
    every = 1 if save_every is None else save_every
    groups = grouped(control, every)
    if save_at is not None:
        _check_times(save_every, save_at, control.pinned.shape[0], solver.dt)
    end, x, v, failures = _run(solver, fabric, state, groups, keep_solutions, saves)
    failures = jnp.where(solver.fits(fabric), failures, Result.TIME_STEP.value)
    unfailed = jnp.cumprod(jnp.all(failures == Result.SUCCESS.value, axis=1)).astype(bool)
    dt = jnp.asarray(solver.dt, x.dtype)
    times = jnp.arange(1, len(x) + 1, dtype=x.dtype) * every * dt
    if save_at is not None:
        times = jnp.asarray(save_at, x.dtype)
        start: Any = state
        x, v = (jnp.concatenate([a[None], b]) for a, b in ((start.x, x), (start.v, v)))
        x, v = between(x, v, times / dt, dt)
        unfailed = unfailed[jnp.clip(jnp.ceil(times / dt).astype(int) - 1, 0)]
    ok = jnp.all(jnp.isfinite(x), axis=(1, 2)) & unfailed
    result, failed_at = _first(failures.ravel(), dt)
    return Solution(x, v, times, end, ok, result, failed_at)


def _run(solver, fabric, state, control, keep_solutions: bool, saves):
    """The state at the end, positions and velocities after every group of steps, and the failures
    (group, step) of all steps."""
    policy = jax.checkpoint_policies.save_only_these_names(*(SAVED,) * keep_solutions)

    def step(state, control):
        state = solver.step(fabric, state, control)
        finite = jnp.all(jnp.isfinite(jax.lax.stop_gradient(state.x)))
        code = jnp.where(finite, Result.SUCCESS.value, Result.NON_FINITE.value)
        return state, first_failure(state.failure, code)

    step = jax.checkpoint(step, policy=policy)

    def group(state, at):
        number, control = at

        def moved():
            end, failures = jax.lax.scan(step, state, control)
            return end, (end.x, end.v, failures)

        if saves is None:
            return moved()
        none = jnp.broadcast_to(no_failure(), control.pinned.shape[:1])
        return jax.lax.cond(number < saves, moved, lambda: (state, (state.x, state.v, none)))

    numbers = jnp.arange(control.pinned.shape[0])
    state, saved = jax.lax.scan(jax.checkpoint(group, policy=policy), state, (numbers, control))
    return state, *saved


def grouped(control: Control, every: int) -> Control:
    """The control of a motion with axes (group, step), in groups of `every` steps."""
    if control.pinned.ndim != 3:
        raise ValueError(
            "control.pinned must be (step, pinned, axis), the control of every step; got an array "
            f"of shape {control.pinned.shape} (of a single step: pinned[None])"
        )
    steps = control.pinned.shape[0]
    if every < 1 or steps % every:
        raise ValueError(f"save_every must divide the {steps} steps of the control, got {every}")
    wind = control.wind
    if wind is not None and wind.ndim == 1:
        wind = jnp.broadcast_to(wind, (steps, 3))
    return jax.tree.map(
        lambda part: part.reshape(steps // every, every, *part.shape[1:]),
        Control(control.pinned, wind),
    )


def _check_times(save_every: int | None, times: Any, steps: int, dt: Any) -> None:
    if save_every is not None:
        raise ValueError("save_every and save_at exclude each other")
    if is_traced(times, dt):
        return
    first, last, end = float(np.min(times)), float(np.max(times)), steps * float(dt)
    if first < 0 or last > end * (1 + 1e-5):
        raise ValueError(
            f"save_at must lie between 0 and {end:g} s, the end of the control; "
            f"found {first:g} to {last:g} s"
        )


def between(
    x: Float[Array, "save vertex axis"],
    v: Float[Array, "save vertex axis"],
    places: Float[Array, " place"],
    dt: Float[Array, ""] | float,
) -> tuple[Float[Array, "place vertex axis"], Float[Array, "place vertex axis"]]:
    """Positions and velocities at `places` between saved ones, which are `dt` apart: the cubic by
    both ends (Hermite). Places count saves from 0; what lies beyond the ends is taken as there."""
    places = jnp.clip(places, 0, len(x) - 1)
    step = jnp.clip(jax.lax.stop_gradient(places).astype(int), 0, len(x) - 2)
    s = (places - step.astype(places.dtype)).astype(x.dtype)[:, None, None]
    (x0, x1), (v0, v1) = (x[step], x[step + 1]), (v[step] * dt, v[step + 1] * dt)
    over = x1 - x0
    at = x0 + s * (v0 + s * (3 * over - 2 * v0 - v1 + s * (v0 + v1 - 2 * over)))
    rate = v0 + s * (2 * (3 * over - 2 * v0 - v1) + 3 * s * (v0 + v1 - 2 * over))
    return at, rate / dt


def _first(failures: Int[Array, " step"], dt: Array) -> tuple[Array, Array]:
    """Code and time [s] of the first failure."""
    if not failures.size:
        return no_failure(), jnp.full((), jnp.nan)
    failed = failures != Result.SUCCESS.value
    first = jnp.argmax(failed)
    return failures[first], jnp.where(failed[first], (first + 1).astype(dt.dtype) * dt, jnp.nan)
