"""Public data sets: what there is, where to get it, and whether it came as it was published.

A data set is a JSON file in `data_manifests/`: a `Dataset`, or the
`r2s.recordings.manifest.Manifest` of recordings that r2s reads as they are. None may be
redistributed or downloaded without a person: each says how it is got.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from r2s._util.checks import shown
from r2s._util.files import load_json, read_json
from r2s.recordings.clouds import read_values
from r2s.recordings.manifest import (
    Manifest,
    default_manifest,
    hash_values,
    read_manifest,
    read_recordings,
)
from r2s.recordings.swings import Bar

SHOWN = 6  # folders that an error names


@dataclass(frozen=True)
class Dataset:
    """A data set that somebody published.

    - `how`: to get it.
    - `layout`: pattern of paths in the folder -> what is there.
    - `note`: what was checked about it, and what was not.
    """

    name: str
    title: str
    citation: str
    licence: str
    how: str
    layout: Mapping[str, str]
    note: str


@dataclass(frozen=True, kw_only=True)
class Swings(Dataset):
    """A data set of swings, and how their sheet is held: `r2s.recordings.swings`."""

    bar: Bar


def known_datasets(folder: Path | str | None = None) -> dict[str, Dataset | Manifest]:
    """The data sets whose manifests lie in `folder` (None: that of the project), by name.

    Raises FileNotFoundError, or ValueError as `read_dataset` and for a repeated name.
    """
    folder = default_manifest().parent if folder is None else Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no folder of manifests: take data_manifests from the project's repository"
        )
    datasets: dict[str, Dataset | Manifest] = {}
    for path in sorted(folder.glob("*.json")):
        data = read_dataset(path)
        if data.name in datasets:
            raise ValueError(f"{path}: there is another data set of the name {data.name!r}")
        datasets[data.name] = data
    return datasets


def read_dataset(path: Path | str) -> Dataset | Manifest:
    """A `Dataset`, or the `Manifest` of recordings (it has "scenarios").

    Raises FileNotFoundError, or a ValueError that names the file and the field.
    """
    keys = load_json(path)
    if not isinstance(keys, dict):
        raise ValueError(f"{path}: expected a JSON object, found {shown(keys)}")
    if "scenarios" in keys:
        return read_manifest(path)
    return read_json(path, Swings if "bar" in keys else Dataset)


def known_bar() -> Bar:
    """The bar of the public swings, whose manifest comes with the package."""
    return read_json(default_manifest().parent / "swings.json", Swings).bar


def fetch(name: str, folder: Path | str, manifests: Path | str | None = None) -> Iterator[str]:
    """Check a data set in a folder against its manifest; says what it finds, line by line.

    At last raises ValueError for files that are corrupt or missing, which says how to get them.
    """
    known = known_datasets(manifests)
    if name not in known:
        raise ValueError(f"no data set {name!r}; there are {', '.join(known)}")
    data, folder = known[name], Path(folder)
    yield f"{name}: {data.title}"
    yield f"licence: {data.licence}"
    yield f"cite: {data.citation}"
    if isinstance(data, Manifest):
        yield from _check_recordings(data, folder)
    else:
        yield from _check_layout(data, folder)


def _check_layout(data: Dataset, folder: Path) -> Iterator[str]:
    """Count the files: nobody published their hashes."""
    lacking = []
    for pattern, what in data.layout.items():
        count = sum(1 for _ in folder.glob(pattern)) if folder.is_dir() else 0
        yield f"{pattern}: {count} found ({what}), not verified"
        if not count:
            lacking.append(pattern)
    if lacking:
        raise ValueError(
            f"{data.name}: cannot be downloaded automatically. {data.how} Put it into {folder} so "
            f"that there is {' and '.join(lacking)}. Licence: {data.licence}."
        )


def _check_recordings(data: Manifest, folder: Path) -> Iterator[str]:
    """Compare the recordings in a folder with the values that were published."""
    names = read_recordings(folder, data) if folder.is_dir() else []
    missing = [path for path in data.files if not (folder / path).is_file()]
    present = {path: value for path, value in data.files.items() if path not in missing}
    corrupt = [path for path, value in present.items() if _hash(folder / path) != value]
    good = len(present) - len(corrupt)
    yield f"{len(names)} recordings in {folder}; {good} of {len(data.files)} files verified"
    problems = []
    if corrupt:
        problems = [f"{folder}: corrupt, not the published values: {', '.join(corrupt)}"]
    if missing or not names:
        source = f"{data.source.repository}, commit {data.source.commit}, {data.source.path}"
        folders = sorted({path.partition("/")[0] for path in missing})
        more = f" and {len(folders) - SHOWN} more" if len(folders) > SHOWN else ""
        wanted = ", ".join(folders[:SHOWN]) + more or "the folders of the recordings"
        problems.append(
            f"{data.name}: cannot be downloaded automatically ({data.licence}). Get it from "
            f"{source} and put into {folder}: {wanted}"
        )
    if problems:
        raise ValueError("; ".join(problems))


def _hash(file: Path) -> str:
    """The hash of a file's values; empty where it cannot be read."""
    try:
        return hash_values(read_values(file))
    except ValueError:
        return ""
