"""Recordings in folders, of images or clouds, to NPZ files; what is up to date is skipped."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

from r2s._util.extras import require
from r2s._util.files import write_text
from r2s.recordings.manifest import (
    Manifest,
    manifest_for,
    manifest_of,
    read_recording,
    read_recordings,
    sources,
)
from r2s.recordings.recording import FORMAT, save


def convert(
    folder: Path | str, to: Path | str, only: str = "", force: bool = False
) -> Iterator[str]:
    """Write `to`/NAME.npz for each recording in a folder; says what it does, line by line.

    `folder` holds recordings, or is one of them; `only` is a regular expression for names. Beside
    each NPZ lies NAME.sha256, of the files that it was made from: one that they still have is up to
    date, and skipped unless `force`. An NPZ is whole or not there, so a run that was killed goes on
    where it was. Raises ValueError or OSError: no such recordings; and, after all the others were
    converted, one for all recordings that could not be read, with file and frame.
    """
    root, names = _names(Path(folder), only)
    manifest, to = manifest_for(root), Path(to)
    to.mkdir(parents=True, exist_ok=True)
    problems = []
    for number, name in enumerate(names, 1):
        try:
            label = f"{name} ({number} of {len(names)})"
            yield f"{name}: {_convert_one(root, manifest, name, to, force, label)}"
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
    found = read_recordings(folder, manifest_for(folder))
    one = folder.resolve()
    if not found and one.name in read_recordings(one.parent, manifest_for(one.parent)):
        return one.parent, [one.name]
    if not (names := [name for name in found if wanted.search(name)]):
        which = f" whose name matches {only!r}; there are {', '.join(found)}"
        hint = (
            f" whose name fits a scenario of {manifest_of(folder)}: write a manifest.json beside "
            "the recordings, as in data_manifests/templates"
        )
        raise ValueError(f"{folder}: no recording{which if found else hint}")
    return folder, names


def _convert_one(
    root: Path, manifest: Manifest, name: str, to: Path, force: bool, label: str
) -> str:
    file, mark = to / f"{name}.npz", to / f"{name}.sha256"
    made_from = _fingerprint(root, sources(root, manifest, name))
    is_there = file.is_file() and mark.is_file()
    if is_there and not force and mark.read_text(encoding="utf-8").strip() == made_from:
        return f"up to date, {file}"
    tqdm = require("tqdm", "study", "progress bars").tqdm
    bar = partial(tqdm, desc=label, unit=" frames", disable=None, leave=False)
    recording = read_recording(root, manifest, name, bar)
    save(recording, file)
    write_text(mark, made_from + "\n")
    points = int(recording.mask.sum())
    return f"{len(recording.times)} frames, {points} points, {file}"


def _fingerprint(root: Path, files: Iterable[Path]) -> str:
    """One sha256 of the names of files, their contents, and the format of recordings."""
    total = hashlib.sha256(FORMAT.encode())
    for file in files:
        total.update(f"\0{file.relative_to(root) if file.is_relative_to(root) else ''}\0".encode())
        with open(file, "rb") as data:
            total.update(hashlib.file_digest(data, "sha256").digest())
    return total.hexdigest()
