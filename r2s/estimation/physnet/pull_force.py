"""The force of a pull as one more coordinate of a frame's point on the map.

A sheet that is stretched on a table stays flat: images hardly tell fabrics apart, and the force on
the clamp does.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimation.problem import force_at
from r2s.recordings.recording import Recording
from r2s.scenarios.energy import clamp_force, energy_balance
from r2s.scenarios.scenario import Scenario, SheetSolver

# A flawed image lies 0.45 from a flawless one on the map (docs/physnet.md), and a sheet of 9 x 9
# vertices errs by some 5 % in the force of a pull: that is to count alike.
FLAW, SHARE = 0.45, 0.05
SCALE = FLAW / SHARE
NOISE = 0.01  # [N] of a load cell, which is to count no more than a flaw either


class PullForce(eqx.Module):
    """The recorded force on the pulled clamp at a sighting's frames.

    - `values`: along the pull, [N]. - `direction`: of the pull, a unit vector. - `least`: less than
      this counts by its difference, more by its ratio, [N].
    """

    values: Float[Array, " frame"]
    direction: Float[Array, "3"]
    least: Float[Array, ""]

    @property
    def recorded(self) -> Float[Array, "frame 1"]:
        """The coordinate of what was recorded."""
        return self._coordinate(self.values)

    def simulated(
        self, scenario: Scenario, found, frames: Sequence[int]
    ) -> Float[Array, "frame 1"]:
        """The coordinate of a motion with its forces (`r2s.scenarios.energy_balance`)."""
        return self._coordinate(clamp_force(scenario, found)[jnp.array(frames)] @ self.direction)

    def _coordinate(self, force):
        return SCALE * jnp.arcsinh(force / self.least)[:, None]


def pull_force(recording: Recording, frames: Sequence[int]) -> PullForce | None:
    """That of a recording at some frames; None where it is no stretching, or has no force.

    What is across the pull is left out: it is noise for the most part. `least` is `SHARE` of the
    largest force, or what lets `NOISE` count like a flawed image.

    Raises what `r2s.estimation.problem.force_at` raises, and `ValueError` where the force is zero.
    """
    force = None
    if recording.info.scenario == "stretching":
        force = force_at(recording, list(frames))
    if force is None:
        return None
    direction = jnp.asarray(recording.info.sheet.warp, float)
    along = force.values @ (force.directions @ direction)
    largest = jnp.max(jnp.abs(along))
    if not largest > 0:
        raise ValueError(f"{recording.info.name}: the force on the pulled clamp is zero throughout")
    return PullForce(along, direction, jnp.maximum(SHARE * largest, NOISE / SHARE))


def moved_with_forces(scenario: Scenario, fabric, solver: SheetSolver | None):
    """A motion with its forces, and whether all of it is finite."""
    found = energy_balance(scenario, fabric, solver=solver)
    return found, jnp.all(jnp.isfinite(found.x)) & jnp.all(jnp.isfinite(found.last))
