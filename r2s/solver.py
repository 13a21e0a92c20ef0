"""From steps to motions: `simulate`, for any solver with `init` and `step`."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.cloth.newton import SAVED
from r2s.world.scene import Control

State = TypeVar("State")


@runtime_checkable
class Solver(Protocol[State]):
    """What `simulate` and the estimators ask of a solver.

    Its fabric is an `r2s.Fabric`, or what else its bodies are made of.
    """

    dt: float

    def step(self, fabric: Any, state: State, control: Control) -> State: ...


def predicted_memory(function: Callable, *args) -> int:
    """The memory [byte] that a jitted call of `function` on `args` will need, before it runs.

    That of arguments, results and all that is held between, as the compiler lays it out:

        predicted_memory(jax.value_and_grad(loss), fabric)

    It compiles, and runs nothing. What a device's libraries take for themselves comes on top.
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    run = jax.jit(lambda arrays: eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array))
    plan = run.lower(arrays).compile().memory_analysis()
    if plan is None:
        raise RuntimeError("this backend's compiler does not say how much memory a program needs")
    return plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes


class Trajectory(eqx.Module):
    """- `x`: positions at the end of every frame, [m].
    - `ok`: whether they are finite; False from the frame on in which a run diverged.
    """

    x: Float[Array, "frame vertex axis"]
    ok: Bool[Array, " frame"]


def simulate(
    solver: Solver[State],
    fabric: Any,
    start: State,
    controls: Control,
    keep_solutions: bool = True,
) -> Trajectory:
    """The motion under `controls`, whose leading axes are (frame, substep).

    A `lax.scan` over frames and steps. Reverse mode keeps one state a frame, and of every step its
    solution, so that it solves nothing again. Without `keep_solutions` it keeps no more than the
    states of the frames, and those of the steps of one frame at a time, which it solves again: the
    time of one more forward run, for the memory of about frames + substeps states.
    """
    names = (SAVED,) if keep_solutions else ()
    policy = jax.checkpoint_policies.save_only_these_names(*names)

    def substep(state, control):
        return solver.step(fabric, state, control), None

    substep = jax.checkpoint(substep, policy=policy)

    def frame(state, control):
        state, _ = jax.lax.scan(substep, state, control)
        return state, state.x  # pyright: ignore[reportAttributeAccessIssue]

    frame = jax.checkpoint(frame, policy=policy)

    _, x = jax.lax.scan(frame, start, controls)
    ok = jnp.all(jnp.isfinite(x), axis=(1, 2))
    return Trajectory(x, ok)
