"""What of a judged recording is drawn: its clouds, and the sheet of every configuration."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from r2s.files import write_bytes


@dataclass(frozen=True)
class MotionComparison:
    """A recording with the motions that were simulated for it, at the frames that are shown.

    - `times`: of the frames, [s].
    - `clouds`: the points of each frame, [m].
    - `faces`: the triangles of every motion.
    - `motions`: the vertices of each configuration, by its label, [m]; not finite where it diverged.

    ValueError, which names the recording, unless there are a cloud and vertices for each frame.
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


def save_shown(path: Path | str, shown: MotionComparison) -> None:
    """Write it as one NPZ, whole or not at all; OSError names the path."""
    labels = list(shown.motions)
    motions: dict[str, Any] = {
        f"motion_{i}": shown.motions[label] for i, label in enumerate(labels)
    }
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        names=np.array([shown.fabric, shown.evaluated_on, shown.recording]),
        labels=np.array(labels, dtype=str),
        times=shown.times,
        points=np.concatenate(shown.clouds),
        counts=np.array([len(cloud) for cloud in shown.clouds]),
        faces=shown.faces,
        **motions,
    )
    write_bytes(path, buffer.getvalue())


def load_shown(path: Path | str) -> MotionComparison:
    """Read what `save_shown` wrote. FileNotFoundError, or a ValueError that names the file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            fabric, evaluated_on, recording = (str(name) for name in file["names"])
            ends = np.cumsum(file["counts"])[:-1]
            return MotionComparison(
                fabric,
                evaluated_on,
                recording,
                file["times"],
                tuple(np.split(file["points"], ends)),
                file["faces"],
                {str(label): file[f"motion_{i}"] for i, label in enumerate(file["labels"])},
            )
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged archive raises anything
        raise ValueError(f"{path}: not what save_shown writes: {error}") from error
