"""What an estimator is given, and what it gives back."""

from collections.abc import Callable
from dataclasses import dataclass, field

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.fabric import Fabric
from r2s.family import OrthotropicFamily
from r2s.recording import Recording, subsample
from r2s.scenario import Scenario, from_recording


class Problem(eqx.Module):
    """A recording to be explained by a member of a family.

    - `scenario`: how the sheet is held and moved.
    - `points`, `mask`: the clouds of the frames that count, [m].
    - `frames`: which frames of the scenario these are.
    - `family`: the fabrics to choose from.
    - `misalignment`: how far the cameras' frame may be off the gripper's, as the standard
      deviations of a shift [m] and of a turn about the vertical [rad]. It is estimated along with
      the fabric, so that an error of calibration is not taken for a property of the fabric.
    """

    scenario: Scenario
    points: Float[Array, "frame point 3"]
    mask: Bool[Array, "frame point"]
    frames: tuple[int, ...] = eqx.field(static=True)
    family: OrthotropicFamily
    misalignment: tuple[float, float] = eqx.field(static=True, default=(0.015, 0.15))

    @classmethod
    def make(
        cls,
        recording: Recording,
        family: OrthotropicFamily,
        *,
        num_points: int = 300,
        voxel: float = 0.008,
        shape: tuple[int, int] = (9, 9),
        seed: int = 0,
    ) -> "Problem":
        """A problem from a recording, its clouds thinned to `num_points` a frame.

        `voxel` [m] is the distance below which points are merged, `shape` the vertices of the
        simulated sheet.
        """
        thinned = subsample(recording, num_points, voxel, seed)
        first, last = recording.info.frames_used
        return cls(
            scenario=from_recording(recording, shape),
            points=thinned.points[first : last + 1],
            mask=thinned.mask[first : last + 1],
            frames=tuple(range(first, last + 1)),
            family=family,
        )


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    `values` are in the order and the units of the family's ranges; `deviation` are their standard
    deviations on the scale of the ranges (relative where logarithmic), from the information that
    the recording has, with the family's bounds as the only prior; `history` holds a row an
    evaluation (loss [m^2], then the values).
    """

    fabric: Fabric
    family: OrthotropicFamily
    place: np.ndarray
    values: np.ndarray
    deviation: np.ndarray
    correlation: np.ndarray
    loss: float
    residual: float  # [m], a robust standard deviation of the distances at the optimum
    history: np.ndarray
    starts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


Progress = Callable[[int, float], None]  # told the iteration and the best loss so far [m^2]
