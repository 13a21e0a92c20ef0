"""From steps to motions: `simulate`, for any solver with `init` and `step`."""

from typing import Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.fabric import Fabric
from r2s.implicit import SAVED
from r2s.scene import Control

State = TypeVar("State")


@runtime_checkable
class Solver(Protocol[State]):
    """What `simulate` and the estimators ask of a solver."""

    dt: float

    def step(self, fabric: Fabric, state: State, control: Control) -> State: ...


class Trajectory(eqx.Module):
    """- `x`: positions at the end of every frame, [m].
    - `ok`: whether they are finite; False from the frame on in which a run diverged.
    """

    x: Float[Array, "frame vertex 3"]
    ok: Bool[Array, " frame"]


def simulate(solver: Solver[State], fabric: Fabric, start: State, controls: Control) -> Trajectory:
    """The motion under `controls`, whose leading axes are (frame, substep).

    A `lax.scan` over frames and steps. Reverse mode keeps one state a step and recomputes the rest
    of each step, without solving it again.
    """
    policy = jax.checkpoint_policies.save_only_these_names(SAVED)

    def substep(state, control):
        return solver.step(fabric, state, control), None

    substep = jax.checkpoint(substep, policy=policy)

    def frame(state, control):
        state, _ = jax.lax.scan(substep, state, control)
        return state, state.x  # pyright: ignore[reportAttributeAccessIssue]

    _, x = jax.lax.scan(frame, start, controls)
    ok = jnp.all(jnp.isfinite(x), axis=(1, 2))
    return Trajectory(x, ok)
