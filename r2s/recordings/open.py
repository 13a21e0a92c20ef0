"""Recordings and simulated motions from paths; conversion of folders to NPZ files."""

import contextlib
import hashlib
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from r2s._util.extras import require
from r2s._util.files import read_npz, write_npz, write_text
from r2s.recordings.checks import at_conversion
from r2s.recordings.datasets import known_bar
from r2s.recordings.manifest import (
    Manifest,
    find,
    manifest_for,
    manifest_of,
    read_recording,
    read_recordings,
    sources,
)
from r2s.recordings.recording import FORMAT, Recording, load, save
from r2s.recordings.segmentation import FrameCuts, shares
from r2s.recordings.strays import without_strays
from r2s.recordings.swings import is_swing, read_swing

Draw = Callable[[Path, str, list[FrameCuts]], None]  # a file, a title, what to draw


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
        return read_swing(path, known_bar()) if is_swing(path) else load(path)
    path = path.resolve()
    folder, name = path.parent, path.name
    if (path / "manifest.json").exists():
        names = read_recordings(path, manifest_for(path))
        if len(names) != 1:
            known = ", ".join(names) or "none that fits its manifest"
            raise ValueError(f"{path}: name one of its recordings, as {path}/NAME: {known}")
        folder, name = path, names[0]
    return read_recording(folder, manifest_for(folder), name)


def open_recordings(paths: Sequence[Path]) -> Iterator[Recording]:
    """Read recordings of NPZ files, folders of them, or folders of frames (`open_recording`).

    Points that are no measurement of the sheet are left out, with a warning (`without_strays`).
    """
    for path in paths:
        files = sorted(path.glob("*.npz"))
        if not files or (path / "manifest.json").exists():
            files = [path]
        for recording in map(open_recording, files):
            recording, said = without_strays(recording)
            if said:
                warnings.warn(f"{recording.info.name}: {said}", stacklevel=2)
            yield recording


def save_trajectory(path: Path | str, x: Any, faces: Any) -> None:
    """Write a motion for `load_trajectory`: `x` (frame, vertex, 3) [m], `faces` (face, 3)."""
    write_npz(path, x=x, faces=faces)


def load_trajectory(path: Path | str) -> SimulatedCloth:
    """Read what `save_trajectory` wrote: an NPZ with `x` and `faces`.

    Positions that are not finite are accepted: a run that diverged is read as far as it went.
    Raises FileNotFoundError, or a ValueError that names the file and what is wrong with it.
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
    if (
        faces.dtype.kind not in "iu"
        or faces.min(initial=0) < 0
        or faces.max(initial=0) >= x.shape[1]
    ):
        raise ValueError(f"{path}: faces must be numbers of the {x.shape[1]} vertices")
    return SimulatedCloth(x, faces)


def convert(
    folder: Path | str,
    to: Path | str,
    only: str = "",
    force: bool = False,
    draw: Draw | None = None,
) -> Iterator[str]:
    """Write `to`/NAME.npz for each recording in a folder; says what it does, line by line.

    `folder` holds recordings, or is one of them; `only` is a regular expression for names. Beside
    each NPZ lies NAME.sha256, of the files that it was made from: one that they still have is up to
    date, and skipped unless `force`. A run that was killed continues where it was. `draw`, such as
    `r2s.viewer.cuts.draw_cuts`, draws NAME_cuts.png: what a segmentation cut off. Raises ValueError
    or OSError: no such recordings; and, after all the others were converted, one for all recordings
    that could not be read, with file and frame.
    """
    root, names = _names(Path(folder), only)
    manifest, to = manifest_for(root), Path(to)
    to.mkdir(parents=True, exist_ok=True)
    problems = []
    for number, name in enumerate(names, 1):
        try:
            label = f"{name} ({number} of {len(names)})"
            yield f"{name}: {_convert_one(root, manifest, name, to, force, label, draw)}"
        except (ValueError, OSError) as error:
            problems.append(str(error))
    if problems:
        done = f"{len(names) - len(problems)} of {len(names)} recordings are converted"
        raise ValueError("; ".join([*problems, done] if len(names) > 1 else problems))


def _names(folder: Path, only: str) -> tuple[Path, list[str]]:
    """The folder of the recordings, and their names."""
    try:
        wanted = re.compile(only)
    except re.error as error:
        raise ValueError(f"only: {only!r} is no regular expression: {error}") from error
    one = folder.resolve()
    with contextlib.suppress(ValueError):  # no manifest
        if one.name in read_recordings(one.parent, manifest_for(one.parent)):
            return one.parent, [one.name]
    known = read_recordings(folder, manifest_for(folder))
    if not known:
        raise ValueError(
            f"{folder}: no recording whose name fits a scenario of {manifest_of(folder)}: write a "
            "manifest.json beside the recordings, as in data_manifests/templates"
        )
    if not (names := [name for name in known if wanted.search(name)]):
        raise ValueError(
            f"{folder}: no recording whose name matches {only!r}; there are {', '.join(known)}"
        )
    return folder, names


def _convert_one(
    root: Path, manifest: Manifest, name: str, to: Path, force: bool, label: str, draw: Draw | None
) -> str:
    file, mark = to / f"{name}.npz", to / f"{name}.sha256"
    total = hashlib.sha256(FORMAT.encode())
    found = find(root, manifest, name)
    for source in sources(found):
        total.update(
            f"\0{source.relative_to(root) if source.is_relative_to(root) else ''}\0".encode()
        )
        with open(source, "rb") as data:
            total.update(hashlib.file_digest(data, "sha256").digest())
    made_from = total.hexdigest()
    is_converted = file.is_file() and mark.is_file()
    if is_converted and not force and mark.read_text(encoding="utf-8").strip() == made_from:
        return f"up to date, {file}"
    tqdm = require("tqdm", "study", "progress bars").tqdm
    bar = partial(tqdm, desc=label, unit=" frames", disable=None, leave=False)
    cuts: list[FrameCuts] = []
    try:
        recording = read_recording(root, manifest, name, bar, cuts, found)
    finally:  # it also shows why a recording is refused
        if draw is not None and cuts:
            draw(to / f"{name}_cuts.png", name, cuts)
    save(recording, file)
    write_text(mark, made_from + "\n")
    said = [f"{len(recording.times)} frames, {int(recording.mask.sum())} points, {file}"]
    said += [f"cuts: {shares(np.sum([c.counts for c in cuts], axis=0))}"] if cuts else []
    said += [finding.describe() for finding in at_conversion(recording) if finding.is_suspicious]
    return "; ".join(said)
