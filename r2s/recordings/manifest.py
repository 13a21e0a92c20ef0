"""Manifests: what a data set of recordings is, and how its numbers become metres and seconds."""

import hashlib
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from r2s._util.files import read_json
from r2s._util.units import positive
from r2s.recordings.camera_fits import fit_cameras
from r2s.recordings.cameras import is_rotation
from r2s.recordings.clouds import READERS, find_numbered, numbers, read_frames, read_values
from r2s.recordings.recording import (
    MeasurementUncertainty,
    Recording,
    RecordingInfo,
    SheetPlacement,
    make_recording,
)
from r2s.recordings.rgbd import find_rig, read_clouds, read_rig
from r2s.recordings.strays import at_one_place, check_unit
from r2s.recordings.views import Views, shifted

Vector = tuple[float, float, float]
Watch = Callable[[Iterable[Any]], Iterable[Any]]


@dataclass(frozen=True)
class Transform:
    """From a file's frame to the world: world = scale * rotation @ p + translation."""

    scale: float = field(metadata={"unknown": "give metres per unit"})
    rotation: tuple[Vector, Vector, Vector]  # rows
    translation: Vector  # [m]

    def __post_init__(self) -> None:
        positive("m per unit", scale=self.scale)
        if not is_rotation(np.array(self.rotation), 1e-6):
            raise ValueError(
                f"rotation must be orthonormal with determinant 1, found {self.rotation}"
            )


@dataclass(frozen=True)
class Gripper:
    """The commanded path: `file` (knot, 3) or (knot, gripper, 3), `rate` knots per second [Hz].

    `offset` [m] is the place of the cloth that is held, in the world, less the commanded tool
    point; `note` says how it was measured.
    """

    file: str
    rate: float
    transform: Transform
    offset: Vector
    note: str

    def __post_init__(self) -> None:
        positive("Hz", rate=self.rate)


@dataclass(frozen=True)
class Session:
    """Recordings of one calibration, and what moves their clouds into the world.

    - `recordings`: a regex for the whole folder name.
    - `shift`: is added to their points in the world, [m]; `note` says how it was found.
    - `workspace`: that they were cropped to, before the shift, [m]; None: that of the scenario's
      views.
    """

    recordings: str
    shift: Vector
    note: str
    workspace: tuple[Vector, Vector] | None = None


@dataclass(frozen=True)
class Scenario:
    """How the recordings of one experiment lie on the disk and in the world.

    `folder`: a regex for the whole folder name, with the groups `fabric` and `trial`. Frame i
    (the first is numbered `first_frame`) is taken at i / frame_rate + time_offset on the
    gripper's clock: a negative offset says that the clouds lag behind the gripper.

    A folder with a cameras.json holds RGB-D images (`r2s.recordings.rgbd`) instead of clouds: the
    cameras' own times or rate come before `frame_rate`, `cloud` transforms from their world, and
    no hashes are kept. If there are `sessions`, a recording belongs to one of them.
    """

    folder: str
    frame_rate: float  # [Hz]
    time_offset: float  # [s]
    cloud: Transform
    gripper: Gripper
    sheet: SheetPlacement
    table_height: float  # [m]
    frames_used: tuple[int, int]  # first and last, inclusive
    drop_repeats: bool  # keep one of points that are equal
    first_frame: int = 0
    sessions: tuple[Session, ...] = ()
    doubt: MeasurementUncertainty | None = None
    views: Views | None = None

    def __post_init__(self) -> None:
        positive("Hz", frame_rate=self.frame_rate)
        if not 0 <= self.frames_used[0] <= self.frames_used[1]:
            raise ValueError(f"frames_used must be [first, last], found {self.frames_used}")
        try:
            groups = re.compile(self.folder).groupindex
        except re.error as error:
            raise ValueError(f"folder {self.folder!r} is no regex: {error}") from error
        if not {"fabric", "trial"} <= groups.keys():
            raise ValueError(f"folder {self.folder!r} lacks the group (?P<fabric>) or (?P<trial>)")


@dataclass(frozen=True)
class Source:
    """Where the data set was published."""

    repository: str
    commit: str
    path: str


@dataclass(frozen=True)
class Manifest:
    """A data set. `files`: path in the folder -> sha256 by `hash_values`; `hash` explains it."""

    name: str
    title: str
    citation: str
    source: Source
    licence: str
    scenarios: Mapping[str, Scenario]
    hash: str
    files: Mapping[str, str]
    note: str


def to_world(transform: Transform, points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    """scale * rotation @ p + translation for each point: metres in the world, of the same shape."""
    rotated = points @ np.array(transform.rotation).T
    return transform.scale * rotated + np.array(transform.translation)


def hash_values(values: np.ndarray) -> str:
    """The sha256 of the values as little-endian float32 in C order, whatever the file's format."""
    return hashlib.sha256(np.asarray(values, "<f4").tobytes()).hexdigest()


def default_manifest() -> Path:
    """The manifest of the public DIFFCLOUD recordings, which comes with the package."""
    return Path(__file__).parents[1] / "data_manifests" / "diffcloud.json"


def manifest_of(folder: Path | str) -> Path:
    """The file of a folder of recordings: its own `manifest.json`, else the default one."""
    own = Path(folder) / "manifest.json"
    return own if own.exists() else default_manifest()


def manifest_for(folder: Path | str) -> Manifest:
    """The manifest of a folder of recordings (`manifest_of`); raises as `read_manifest`."""
    return read_manifest(manifest_of(folder))


def read_manifest(path: Path | str) -> Manifest:
    """Read a manifest from JSON: the fields of `Manifest`, no more and (but for defaults) no less.

    Raises FileNotFoundError, or a ValueError that names the file and the field.
    """
    return read_json(path, Manifest)


def read_recordings(
    folder: Path | str, manifest: Manifest, scenarios: Sequence[str] | None = None
) -> list[str]:
    """The names of the recordings in `folder`, sorted; `scenarios` (None: all) selects.

    Any folder whose name fits a scenario counts, also fabrics and trials that the manifest does
    not list. Raises FileNotFoundError (no such folder), ValueError (no such scenario).
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of recordings")
    wanted = list(manifest.scenarios) if scenarios is None else scenarios
    for name in wanted:
        if name not in manifest.scenarios:
            raise ValueError(f"unknown scenario {name!r}, known: {list(manifest.scenarios)}")
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    return [n for n in names if any(re.fullmatch(manifest.scenarios[s].folder, n) for s in wanted)]


def sources(folder: Path | str, manifest: Manifest, name: str) -> list[Path]:
    """The files that a recording is read from, as far as they exist, sorted.

    Its manifest, the gripper's path, cameras.json, and all in its folder but colour images.
    """
    folder = Path(folder)
    gripper = folder / _scenario_of(manifest, name)[1].gripper.file
    inside = (path for path in (folder / name).rglob("*") if path.parent.name != "colour")
    files = (manifest_of(folder), gripper, find_rig(folder / name), *inside)
    return sorted({path for path in files if path is not None and path.is_file()})


def read_recording(
    folder: Path | str, manifest: Manifest, name: str, watch: Watch = iter
) -> Recording:
    """The recording in `folder`/`name`, of clouds or of RGB-D images, in metres and seconds.

    Frames are read through `watch`, such as a bar that shows progress.

    `info.verified`: True if all its files have the values listed in the manifest, None if some are
    not listed; False, with a warning, if a listed one differs or is missing.

    Raises FileNotFoundError or a ValueError that names the file or folder.
    """
    folder = Path(folder)
    scenario_name, scenario, match = _scenario_of(manifest, name)
    path = _read_path(folder / scenario.gripper.file)
    rig, alone = None, []
    if find_rig(folder / name):
        rig = read_rig(folder / name)
        times, clouds = read_clouds(folder / name, rig, scenario.frame_rate, watch, alone)
        verified = None
    else:
        frames = list(find_numbered(folder / name, READERS, scenario.first_frame).values())
        times = np.arange(len(frames)) / scenario.frame_rate
        clouds = read_frames(watch(frames))
        files = {f"{name}/{frame.name}": c for frame, c in zip(frames, clouds, strict=True)}
        verified = _verify(manifest.files, name, files | {scenario.gripper.file: path})
        if scenario.drop_repeats:
            clouds = [_distinct(points) for points in clouds]
    shift, views = (0.0, 0.0, 0.0), scenario.views
    if scenario.sessions:
        patterns = [session.recordings for session in scenario.sessions]
        session = scenario.sessions[_matching(name, patterns, "sessions")[0]]
        shift = session.shift
        if views is not None:
            box = session.workspace or views.clean.workspace
            views = replace(views, clean=replace(views.clean, workspace=box))
            views = shifted(views, shift)

    def in_world(points: np.ndarray) -> np.ndarray:
        return to_world(scenario.cloud, points) + np.array(shift)

    source = f"{manifest.source.repository} {manifest.source.commit} {manifest.source.path}"
    info = RecordingInfo(
        name=name,
        scenario=scenario_name,
        fabric=match["fabric"],
        trial=match["trial"] or "1",
        source=source if verified else str(folder / name),
        frames_used=scenario.frames_used,
        sheet=scenario.sheet,
        table_height=scenario.table_height,
        verified=verified,
        time_offset=scenario.time_offset,
        doubt=scenario.doubt,
        views=views,
        camera_fits=fit_cameras(rig.cameras, alone, scenario.sheet, in_world) if rig else (),
    )
    clouds = [in_world(points) for points in clouds]
    check_unit(folder / name, clouds[0], scenario.sheet.size)
    return make_recording(
        clouds,
        times + scenario.time_offset,
        to_world(scenario.gripper.transform, path) + np.array(scenario.gripper.offset),
        np.arange(len(path)) / scenario.gripper.rate,
        info,
    )


def _matching(name: str, patterns: Sequence[str], kind: str) -> tuple[int, re.Match[str]]:
    """The one of some patterns that the name of a recording fits, by its number."""
    matches = [re.fullmatch(pattern, name) for pattern in patterns]
    fits = [(index, match) for index, match in enumerate(matches) if match]
    if len(fits) != 1:
        raise ValueError(f"{name!r} fits {len(fits)} {kind}, expected one of: {list(patterns)}")
    return fits[0]


def _scenario_of(manifest: Manifest, name: str) -> tuple[str, Scenario, re.Match[str]]:
    """The scenario of a recording, and the match of its folder with groups fabric and trial."""
    known = list(manifest.scenarios.items())
    index, match = _matching(name, [scenario.folder for _, scenario in known], "scenarios")
    return *known[index], match


def _read_path(file: Path) -> np.ndarray:
    path = read_values(file)
    try:
        return numbers("the gripper path", path, "knot", *["gripper"] * (path.ndim - 2), 3)
    except ValueError as error:
        raise ValueError(f"{file}: {error}: expected (knot, 3) or (knot, gripper, 3)") from error


def _verify(listed: Mapping[str, str], name: str, values: Mapping[str, np.ndarray]) -> bool | None:
    """Whether values of files are those listed for a recording; None: some are not listed."""
    differ = [f for f, v in values.items() if f in listed and hash_values(v) != listed[f]]
    differ += [f for f in listed if f.startswith(f"{name}/") and f not in values]
    if differ:
        warnings.warn(
            f"{name}: not the published values, or missing: {', '.join(differ)}", stacklevel=3
        )
        return False
    return True if values.keys() <= listed.keys() else None


def _distinct(points: np.ndarray) -> np.ndarray:
    """One of points that are equal; all where they are too many, which `check` counts."""
    kept = at_one_place(points)
    kept[np.unique(points, axis=0, return_index=True)[1]] = True
    return points[kept]
