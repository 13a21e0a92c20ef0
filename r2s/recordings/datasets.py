"""Public data sets: what there is, where to get it, and whether it came as it was published.

A data set is a JSON file in `data_manifests/`: a `Dataset`, or the
`r2s.recordings.manifest.Manifest` of recordings that r2s reads as they are. Downloading needs
pooch: pip install 'r2s[data]'.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from r2s._util.extras import require
from r2s._util.files import read_json
from r2s.recordings.clouds import read_values
from r2s.recordings.manifest import (
    Manifest,
    default_manifest,
    hash_values,
    read_manifest,
    read_recordings,
)
from r2s.recordings.swings import Bar

TIMEOUT = 30  # [s], without a byte from the server
SHOWN = 6  # folders that an error names


@dataclass(frozen=True)
class Download:
    """A file that anybody may download: where it is, and the sha256 of the whole of it."""

    url: str
    sha256: str

    def __post_init__(self) -> None:
        if not re.fullmatch("[0-9a-f]{64}", self.sha256):
            raise ValueError(f"sha256 must be 64 hexadecimal digits, found {self.sha256!r}")
        if not re.match("https?://", self.url):
            raise ValueError(f"url must begin with https:// or http://, found {self.url!r}")


@dataclass(frozen=True)
class Dataset:
    """A data set that somebody published.

    - `how`: to get what `downloads` (path in the folder -> file) lacks.
    - `layout`: pattern of paths in the folder -> what is there, of what is fetched by hand.
    - `note`: what was checked about it, and what was not.
    """

    name: str
    title: str
    citation: str
    licence: str
    how: str
    layout: Mapping[str, str]
    downloads: Mapping[str, Download]
    note: str

    def __post_init__(self) -> None:
        for path in (*self.layout, *self.downloads):
            if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts:
                raise ValueError(f"paths must stay in the folder of the data, found {path!r}")


@dataclass(frozen=True, kw_only=True)
class Swings(Dataset):
    """A data set of swings, and how their sheet is held: `r2s.recordings.swings`."""

    bar: Bar


def known_datasets(folder: Path | str | None = None) -> dict[str, Dataset | Manifest]:
    """The data sets whose manifests lie in `folder` (None: that of the project), by name.

    Raises FileNotFoundError when there is no such folder, ValueError as `read_dataset`, or when
    two manifests have one name.
    """
    folder = default_manifest().parent if folder is None else Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no folder of manifests: take data_manifests from the project's repository"
        )
    found: dict[str, Dataset | Manifest] = {}
    for path in sorted(folder.glob("*.json")):
        data = read_dataset(path)
        if data.name in found:
            raise ValueError(f"{path}: a data set of the name {data.name!r} is there already")
        found[data.name] = data
    return found


def read_dataset(path: Path | str) -> Dataset | Manifest:
    """A `Dataset`, or the `Manifest` of recordings (it has "scenarios").

    Raises FileNotFoundError, or a ValueError that names the file and the field.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: no JSON: {error}") from error
    if isinstance(value, dict) and "scenarios" in value:
        return read_manifest(path)
    return read_json(path, Swings if isinstance(value, dict) and "bar" in value else Dataset)


def known_bar() -> Bar:
    """The bar of the public swings, whose manifest comes with the package."""
    return read_json(default_manifest().parent / "swings.json", Swings).bar


def fetch(name: str, folder: Path | str, manifests: Path | str | None = None) -> Iterator[str]:
    """Bring a data set into a folder, as far as possible; says what it does, line by line.

    Corrupt files are never replaced: the error says which to delete. Raises ValueError or OSError,
    after all else was done: an unknown name, files that are corrupt, missing on the server, or that
    must be fetched by hand; the error then says how, and where to put them.
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
        yield from _download_all(data, folder)
        yield from _check_layout(data, folder)


def _download_all(data: Dataset, folder: Path) -> Iterator[str]:
    problems = []
    for path, download in data.downloads.items():
        try:
            yield _fetch_file(folder, path, download)
        except (ValueError, OSError) as error:
            problems.append(str(error))
    if problems:
        raise ValueError("; ".join(problems))


def _fetch_file(folder: Path, path: str, download: Download) -> str:
    """Have a file, complete and verified; what was done."""
    pooch = require("pooch", "data", "downloads")
    pooch.get_logger().setLevel("ERROR")  # what is done is said here
    file = folder / path
    if file.exists():
        found = pooch.file_hash(str(file), alg="sha256")
        if found != download.sha256:
            # pooch would replace it: it may be the only copy of something else
            raise ValueError(
                f"{file}: corrupt: sha256 {found[:12]}..., published is {download.sha256[:12]}...: "
                "delete it and run the command again"
            )
        return f"{path}: there, verified"
    try:
        pooch.retrieve(
            download.url,
            f"sha256:{download.sha256}",
            fname=file.name,
            path=file.parent,
            downloader=pooch.HTTPDownloader(timeout=TIMEOUT),
        )
    except ValueError as error:
        raise ValueError(
            f"{file}: corrupt: what {download.url} sent is not the published file (sha256 "
            f"{download.sha256[:12]}...): it was discarded; run the command again, or tell whoever "
            "keeps the data"
        ) from error
    except OSError as error:  # those of requests are such
        raise OSError(f"{download.url}: {error}: check the address and run it again") from error
    return f"{path}: downloaded, verified"


def _check_layout(data: Dataset, folder: Path) -> Iterator[str]:
    """Count what must be fetched by hand: nobody published its hashes."""
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
    corrupt = [
        path
        for path, expected in data.files.items()
        if path not in missing and _hash(folder / path) != expected
    ]
    good = len(data.files) - len(missing) - len(corrupt)
    yield f"{len(names)} recordings in {folder}; {good} of {len(data.files)} files verified"
    problems = []
    if corrupt:
        problems = [f"{folder}: corrupt, not the published values: {', '.join(corrupt)}"]
    if missing or not names:
        source = f"{data.source.repository}, commit {data.source.commit}, {data.source.path}"
        folders = sorted({path.partition("/")[0] for path in missing})
        more = f" and {len(folders) - SHOWN} more" if len(folders) > SHOWN else ""
        shown = ", ".join(folders[:SHOWN]) + more
        problems.append(
            f"{data.name}: cannot be downloaded automatically ({data.licence}). Get it from "
            f"{source} and put into {folder}: {shown or 'the folders of the recordings'}"
        )
    if problems:
        raise ValueError("; ".join(problems))


def _hash(file: Path) -> str:
    """The hash of a file's values; empty where it cannot be read."""
    try:
        return hash_values(read_values(file))
    except ValueError:
        return ""
