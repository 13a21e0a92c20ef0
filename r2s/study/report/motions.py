"""A judged recording beside the motions that were simulated for it: what pictures are made of."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer

from r2s.evaluation.horizon import within
from r2s.study.configuration import is_reference


@dataclass(frozen=True)
class MotionComparison:
    """A recording with the motions that were simulated for it, at the frames that are shown.

    - `times`: of the frames, [s].
    - `clouds`: the points of each frame, [m].
    - `faces`: the triangles of each configuration's sheet, by its label.
    - `motions`: the vertices of each configuration, by its label, [m]; not finite where it
      diverged. Of several runs (estimates, or draws of the default) one.
    - `errors`: the distances of the points from the sheets of all runs, [m]; not finite from where
      one diverged.
    - `floor`: what the recording itself is known to, [m]. `horizon`: until when it tells fabrics
      apart, [s]. None: not known.

    Raises ValueError, which names the recording, unless there are a cloud, vertices and errors for
    each frame.
    """

    fabric: str
    evaluated_on: str
    recording: str
    times: Float[np.ndarray, " frame"]
    clouds: tuple[Float[np.ndarray, "_ 3"], ...]
    faces: Mapping[str, Integer[np.ndarray, "face 3"]]
    motions: Mapping[str, Float[np.ndarray, "frame vertex 3"]]
    errors: Mapping[str, Float[np.ndarray, "run frame"]]
    floor: Float[np.ndarray, " frame"] | None = None
    horizon: float | None = None

    def __post_init__(self) -> None:
        count = len(self.times)
        if len(self.clouds) != count or not count:
            raise ValueError(
                f"{self.recording}: expected a cloud for each of {count} frames (one or more), "
                f"found {len(self.clouds)}"
            )
        for name, given in (("faces", self.faces), ("errors", self.errors)):
            if given.keys() != self.motions.keys():
                raise ValueError(
                    f"{self.recording}: expected {name} of {', '.join(self.motions)}, found those "
                    f"of {', '.join(given)}"
                )
        for label, x in self.motions.items():
            where, faces, errors = f"{self.recording}, {label}", self.faces[label], self.errors
            if x.ndim != 3 or x.shape[0] != count or x.shape[2] != 3:
                raise ValueError(f"{where}: expected ({count}, vertex, 3), found {x.shape}")
            if len(faces) and faces.max() >= x.shape[1]:
                raise ValueError(
                    f"{where}: the faces name vertex {faces.max()}, but there are {x.shape[1]}"
                )
            if errors[label].ndim != 2 or errors[label].shape[1] != count:
                found = errors[label].shape
                raise ValueError(f"{where}: expected errors (run, {count}), found {found}")

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon; all, where none is known."""
        return within(self.times, np.inf if self.horizon is None else self.horizon)

    @property
    def mean_errors(self) -> dict[str, Float[np.ndarray, " frame"]]:
        """The mean over runs, [m]; infinite where one of them has diverged."""
        return {
            label: np.mean(np.where(np.isfinite(runs), runs, np.inf), axis=0)
            for label, runs in self.errors.items()
        }


def deciding_frame(comparison: MotionComparison) -> int | None:
    """The frame before the horizon at which what is compared is farthest apart in error.

    Those are the configurations, where there are two or more, else all that there is, as references
    and the default; a single one where it is worst. What has diverged does not count, nor do clouds
    with less than half of the points of the largest: cameras saw little then. None where no frame
    is left.
    """
    counts = np.array([len(cloud) for cloud in comparison.clouds])
    allowed = comparison.inside & (counts > 0) & (2 * counts >= counts.max())
    every = comparison.mean_errors
    estimates = [label for label in every if not is_reference(label)]
    rivals = np.array([every[label] for label in (estimates if len(estimates) > 1 else every)])
    if not len(rivals) or not allowed.any():
        return None
    finite = np.isfinite(rivals)
    largest = np.where(finite, rivals, 0.0).max(axis=0)
    smallest = np.where(finite, rivals, np.inf).min(axis=0) if len(rivals) > 1 else 0.0
    apart = np.where(finite.any(axis=0), largest - smallest, 0.0)
    return int(np.argmax(np.where(allowed, apart, -1.0)))
