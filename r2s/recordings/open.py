"""Recordings and simulated motions from paths: NPZ files, or folders of frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from r2s._util.files import read_npz, write_npz
from r2s.recordings.datasets import known_bar
from r2s.recordings.manifest import manifest_for, read_recording, read_recordings
from r2s.recordings.readers.swings import is_swing, read_swing
from r2s.recordings.recording import Recording, load


@dataclass(frozen=True)
class SimulatedCloth:
    """A simulated motion: `x` [m] at each frame, and the triangles `faces`."""

    x: Float[np.ndarray, "frame vertex 3"]
    faces: Integer[np.ndarray, "face 3"]


def open_recording(path: Path | str) -> Recording:
    """Read a recording from an NPZ, also one of the public swings, or from a folder of frames.

    A folder's manifest is the `manifest.json` beside it, else that of DIFFCLOUD; a folder that
    holds a manifest.json and one recording is taken for that. Raises FileNotFoundError or
    ValueError that names the path, and the recordings there are when there are several.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such recording, neither an NPZ nor a folder")
    if path.is_file():
        return _load(path)
    path = path.resolve()
    if (path / "manifest.json").exists():
        manifest = manifest_for(path)
        names = read_recordings(path, manifest)
        if len(names) != 1:
            known = ", ".join(names) or "none that fits its manifest"
            raise ValueError(f"{path}: name one of its recordings, as {path}/NAME: {known}")
        return read_recording(path, manifest, names[0])
    return read_recording(path.parent, manifest_for(path.parent), path.name)


def _load(path: Path) -> Recording:
    """Of this format, or of the public swings."""
    return read_swing(path, known_bar()) if is_swing(path) else load(path)


def open_recordings(paths: Sequence[Path]) -> Iterator[Recording]:
    """Read recordings: of NPZ files, of folders of them, or of folders of clouds or images.

    Raises as `open_recording`.
    """
    for path in paths:
        files = sorted(path.glob("*.npz")) if path.is_dir() else []
        if files and not (path / "manifest.json").exists():
            yield from map(_load, files)
        else:
            yield open_recording(path)


def save_trajectory(path: Path | str, x: Any, faces: Any) -> None:
    """Write a motion for `load_trajectory`: `x` (frame, vertex, 3) [m], `faces` (face, 3)."""
    write_npz(path, x=x, faces=faces)


def load_trajectory(path: Path | str) -> SimulatedCloth:
    """Read what `save_trajectory` wrote: an NPZ with `x` and `faces`.

    Positions that are not finite are accepted: a run that diverged is read as far as it went.
    Raises FileNotFoundError, or a ValueError that names the file: it is damaged, an array is
    missing or of another shape, or a face has a vertex that does not exist.
    """
    try:
        arrays = read_npz(path, "x", "faces")
    except ValueError as error:
        raise ValueError(f"{path}: no trajectory (NPZ with x and faces): {error}") from error
    x, faces = np.asarray(arrays["x"], float), arrays["faces"]
    if x.ndim != 3 or x.shape[2] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(
            f"{path}: expected x (frame, vertex, 3) [m] and faces (face, 3), found {x.shape} and "
            f"{faces.shape}"
        )
    if faces.dtype.kind not in "iu" or faces.min(initial=0) < 0 or faces.max() >= x.shape[1]:
        raise ValueError(f"{path}: faces must be numbers of the {x.shape[1]} vertices")
    return SimulatedCloth(x, faces)
