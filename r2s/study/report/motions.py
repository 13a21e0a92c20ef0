"""A judged recording beside the motions that were simulated for it: what pictures are made of."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Integer


@dataclass(frozen=True)
class MotionComparison:
    """A recording with the motions that were simulated for it, at the frames that are shown.

    - `times`: of the frames, [s].
    - `clouds`: the points of each frame, [m].
    - `faces`: the triangles of every motion.
    - `motions`: the vertices of each configuration, by its label, [m]; not finite where it
      diverged.

    Raises ValueError, which names the recording, unless there are a cloud and vertices for each
    frame.
    """

    fabric: str
    evaluated_on: str
    recording: str
    times: Float[np.ndarray, " frame"]
    clouds: tuple[Float[np.ndarray, "_ 3"], ...]
    faces: Integer[np.ndarray, "face 3"]
    motions: Mapping[str, Float[np.ndarray, "frame vertex 3"]]

    def __post_init__(self) -> None:
        count = len(self.times)
        if len(self.clouds) != count or not count:
            raise ValueError(
                f"{self.recording}: expected a cloud for each of {count} frames (one or more), "
                f"found {len(self.clouds)}"
            )
        for label, x in self.motions.items():
            if x.ndim != 3 or x.shape[0] != count or x.shape[2] != 3:
                raise ValueError(
                    f"{self.recording}, {label}: expected ({count}, vertex, 3), found {x.shape}"
                )
            if len(self.faces) and self.faces.max() >= x.shape[1]:
                raise ValueError(
                    f"{self.recording}, {label}: the faces name vertex {self.faces.max()}, but "
                    f"there are {x.shape[1]}"
                )
