"""The force of a pull as more coordinates of a frame's point on the map.

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
from r2s.scenarios.scenario import Scenario
from r2s.solver import Solver

# A flawed image lies 0.45 from a flawless one on the map (docs/physnet.md), and a sheet of 9 x 9
# vertices errs by some 5 % in the force of a pull: that is to count alike.
SCALE = 0.45 / 0.05
LEAST = 0.05  # of the largest recorded force: less counts by its difference, not its ratio


class PullForce(eqx.Module):
    """The recorded force on the pulled clamp at a sighting's frames.

    - `values`: along some `directions`, [N]. - `least`: see `LEAST`, [N].
    """

    values: Float[Array, "frame direction"]
    directions: Float[Array, "direction 3"]
    least: Float[Array, ""]

    @property
    def recorded(self) -> Float[Array, "frame direction"]:
        """The coordinates of what was recorded."""
        return self._coordinates(self.values)

    def simulated(
        self, scenario: Scenario, found, frames: Sequence[int]
    ) -> Float[Array, "frame direction"]:
        """The coordinates of a motion with its forces (`r2s.scenarios.energy_balance`)."""
        force = clamp_force(scenario, found)[jnp.array(frames)]
        return self._coordinates(force @ self.directions.T)

    def _coordinates(self, force):
        return SCALE * jnp.arcsinh(force / self.least)


def pull_force(recording: Recording, frames: Sequence[int]) -> PullForce | None:
    """That of a recording at some frames; None where it is no stretching, or has no force.

    Raises what `r2s.estimation.problem.force_at` raises, and `ValueError` where the force is zero.
    """
    force = None
    if recording.info.scenario == "stretching":
        force = force_at(recording, list(frames))
    if force is None:
        return None
    largest = jnp.max(jnp.abs(force.values))
    if not largest > 0:
        raise ValueError(f"{recording.info.name}: the force on the pulled clamp is zero throughout")
    return PullForce(force.values, force.directions, LEAST * largest)


def moved_with_forces(scenario: Scenario, fabric, solver: Solver | None):
    """A motion with its forces, and whether all of it is finite."""
    found = energy_balance(scenario, fabric, solver=solver)
    return found, jnp.all(jnp.isfinite(found.x)) & jnp.all(jnp.isfinite(found.last))
