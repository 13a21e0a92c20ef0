"""From steps to motions: `simulate`, for any solver with `init` and `step`."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.threads import planned
from r2s.environment.scene import Control
from r2s.solvers.failures import Failure, describe, first_failure, no_failure
from r2s.solvers.implicit.newton import SAVED

State = TypeVar("State")


@runtime_checkable
class Solver(Protocol[State]):
    """What `simulate` and the estimators ask of a solver.

    Its fabric is an `r2s.Fabric`, or what else its bodies are made of. A state has positions `x`
    [m] and a `failure` (`r2s.Failure`).
    """

    dt: float  # [s]

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

    That of arguments, results and all that is held between. Nothing runs. What a device's libraries
    take for themselves comes on top.

        predicted_memory(jax.value_and_grad(loss), fabric)
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    run = jax.jit(lambda arrays: eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array))
    return planned(run.lower(arrays).compile())


class Trajectory(eqx.Module):
    """A motion, and whether and where it failed. Under `jax.vmap` every field has a batch axis.

    - `x`: positions at the end of every frame, [m].
    - `ok`: whether they are finite and nothing failed; False from the frame on in which a run did.
    - `failure`: why, an `r2s.solvers.failures.Failure`; 0: it did not fail.
    - `failed_frame`, `failed_step`: the frame, and the step in it, of the first failure; -1: none.
    """

    x: Float[Array, "frame vertex axis"]
    ok: Bool[Array, " frame"]
    failure: Int[Array, ""]
    failed_frame: Int[Array, ""]
    failed_step: Int[Array, ""]

    def from_frame(self, first: int) -> "Trajectory":
        """The motion from a frame on, which becomes frame 0. A failure before it has a negative
        frame.
        """
        frame = jnp.where(self.failure == 0, -1, self.failed_frame - first)
        return Trajectory(self.x[first:], self.ok[first:], self.failure, frame, self.failed_step)

    def explain(self) -> str:
        """One sentence: what failed, in which frame and step; empty when nothing did.

        It is that of one run; of a batch, pick a member first. Raises `ValueError` for a batch.
        """
        if self.failure.ndim:
            raise ValueError(f"expected one run, got a batch of shape {self.failure.shape}")
        if not int(self.failure):
            return ""
        frame, step = int(self.failed_frame), int(self.failed_step)
        where = f"frame {frame}" if frame >= 0 else f"{-frame} frames before the first one"
        return f"failed in {where}, step {step}: {describe(int(self.failure))}"


def simulate(
    solver: Solver[State],
    fabric: Any,
    start: State,
    controls: Control,
    keep_solutions: bool = True,
    frames: Int[Array, ""] | int | None = None,
) -> Trajectory:
    """The motion under `controls`, whose leading axes are (frame, substep).

    `frames`: how many are simulated, which may be traced; the others repeat the last. None: all.
    Raises `ValueError` for a fabric that is too stiff for the solver's steps (`Solver.check`); a
    run with a traced one fails in its first step (`Failure.TIME_STEP`).

    Reverse mode keeps one state a frame, and of every step its solution. Without `keep_solutions`
    it keeps the states of the frames alone and solves the steps of one frame at a time again: the
    time of one more forward run, for the memory of about frames + substeps states.
    """
    if not is_traced(solver, fabric):
        solver.check(fabric)
    names = (SAVED,) if keep_solutions else ()
    policy = jax.checkpoint_policies.save_only_these_names(*names)

    def substep(state, control):
        state = solver.step(fabric, state, control)
        return state, _failure(state)

    substep = jax.checkpoint(substep, policy=policy)

    def moved(state, control):
        state, failures = jax.lax.scan(substep, state, control)
        return state, (state.x, failures)  # pyright: ignore[reportAttributeAccessIssue]

    def wanted(state, at):
        number, control = at

        def still():
            steps = jax.tree.leaves(control)[0].shape[0]
            return state, (state.x, jnp.broadcast_to(no_failure(), (steps,)))

        return jax.lax.cond(number < frames, lambda: moved(state, control), still)

    if frames is None:
        _, (x, failures) = jax.lax.scan(jax.checkpoint(moved, policy=policy), start, controls)
    else:
        numbers = jnp.arange(jax.tree.leaves(controls)[0].shape[0])
        wanted = jax.checkpoint(wanted, policy=policy)
        _, (x, failures) = jax.lax.scan(wanted, start, (numbers, controls))
    # once, and not in every step
    failures = jnp.where(solver.fits(fabric), failures, Failure.TIME_STEP.value)
    unfailed = jnp.all(failures == Failure.NONE.value, axis=1)
    ok = jnp.all(jnp.isfinite(x), axis=(1, 2)) & jnp.cumprod(unfailed).astype(bool)
    return Trajectory(x, ok, *_first_failure(failures))


def _failure(state: Any) -> Int[Array, ""]:
    """The failure that a state carries, or that its positions are not finite."""
    finite = jnp.all(jnp.isfinite(jax.lax.stop_gradient(state.x)))
    seen = jnp.where(finite, Failure.NONE.value, Failure.NON_FINITE.value)
    return first_failure(state.failure, seen)


def _first_failure(failures: Int[Array, "frame step"]) -> tuple[Array, Array, Array]:
    """Code, frame and step of the first failure."""
    if not failures.size:
        return no_failure(), no_failure() - 1, no_failure() - 1
    failures, steps = failures.ravel(), failures.shape[1]
    first = jnp.argmax(failures != Failure.NONE.value)
    code = failures[first]
    failed = code != Failure.NONE.value
    return code, jnp.where(failed, first // steps, -1), jnp.where(failed, first % steps, -1)
