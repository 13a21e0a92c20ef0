"""Manifests: what a data set of recordings is, and how its numbers become metres and seconds."""

import hashlib
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from r2s._util.files import read_json
from r2s._util.units import not_negative, positive
from r2s.recordings.cameras import is_rotation
from r2s.recordings.clocks import EPOCH, TABLE, Frames, find_frames, places_of, times_of
from r2s.recordings.clouds import READERS, read_frames, read_values
from r2s.recordings.gripper_paths import ORDERS, Track, merged, read_track, with_tool
from r2s.recordings.recording import (
    MeasurementUncertainty,
    Recording,
    RecordingInfo,
    SheetPlacement,
    first_motion,
    make_recording,
)
from r2s.recordings.rgbd import (
    Images,
    Rig,
    find_images,
    find_rig,
    read_clouds,
    read_rig,
    used_times,
    with_cameras,
)
from r2s.recordings.segmentation import FrameCuts, Segmentation, Segmenter, read_colours
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


IDENTITY = Transform(1.0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Gripper:
    """The path of the grippers.

    - `file`: as `r2s.recordings.gripper_paths.read_track` reads it; of several grippers one file
      each, with ";" between, in the order of `pinned`. "{name}", "{fabric}" and "{trial}" stand for
      those of a recording.
    - `rate`: knots per second, [Hz]; 0: the file has their times, on the clock of the frames.
    - `offset`: the place of the cloth that is held, in the world, less the tool point, [m];
      `tool_offset`: the same in the tool's axes, which turn with the tool. `note` says how these
      were measured.
    - `quaternion_order`: of npz and json, "xyzw" or "wxyz".
    """

    file: str
    rate: float = 0.0  # [Hz]
    transform: Transform = IDENTITY
    offset: Vector = (0.0, 0.0, 0.0)
    note: str = ""
    tool_offset: Vector = (0.0, 0.0, 0.0)
    quaternion_order: str = ""

    def __post_init__(self) -> None:
        not_negative("Hz", rate=self.rate)
        if self.quaternion_order not in ("", *ORDERS):
            raise ValueError(f"quaternion_order must be xyzw or wxyz, got {self.quaternion_order}")


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

    - `folder`: a regex for the whole folder name, with the groups `fabric` and `trial`.
    - `frame_rate`: [Hz], of frames without times: one is taken at its number, less `first_frame`,
      over this. 0: they have times, in times.csv of their folder (one line a frame, [s]) or in
      their names (`r2s.recordings.clocks`).
    - `time_offset`: added to the frames' times, [s]; negative where they lag behind the grippers.
    - `frames_used`: the first and the last that count, inclusive, by their numbers less
      `first_frame`; of frames with times in their order. Empty: all.

    A folder with a cameras.json holds RGB-D images (`r2s.recordings.rgbd`) instead of clouds: the
    cameras' own times or rate come before `frame_rate`, `cloud` transforms from their world, and
    no hashes are kept. If there are `sessions`, a recording belongs to one of them. `segmentation`
    cuts the cloth out of clouds, or of images without masks unless cameras.json has its own.
    """

    folder: str
    gripper: Gripper
    sheet: SheetPlacement
    frame_rate: float = 0.0  # [Hz]
    time_offset: float = 0.0  # [s]
    cloud: Transform = IDENTITY
    table_height: float = 0.0  # [m]
    frames_used: tuple[int, ...] = ()
    drop_repeats: bool = False  # keep one of points that are equal
    first_frame: int = 0
    sessions: tuple[Session, ...] = ()
    doubt: MeasurementUncertainty | None = None
    views: Views | None = None
    segmentation: Segmentation | None = None

    def __post_init__(self) -> None:
        not_negative("Hz", frame_rate=self.frame_rate)
        used = self.frames_used
        if used and not (len(used) == 2 and 0 <= used[0] <= used[1]):
            raise ValueError(
                f"frames_used must be [first, last], from 0 and in this order, found {list(used)}"
            )
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
    """The file of a folder of recordings: its own `manifest.json`, or the default one where the
    grippers' paths are those of DIFFCLOUD. Raises ValueError for another folder without."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of recordings")
    if (own := folder / "manifest.json").exists():
        return own
    published = read_manifest(default_manifest())
    for name in {scenario.gripper.file for scenario in published.scenarios.values()}:
        file = folder / name
        if file.is_file() and hash_values(read_values(file)) == published.files.get(name):
            return default_manifest()
    raise ValueError(
        f"{folder}: no manifest.json, which gives scale, frame rate, sheet and grippers: copy "
        "data_manifests/templates/study.json there and edit it"
    )


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


class Found(NamedTuple):
    """A recording in a folder: what it is read from, listed once.

    - `folder`: its own. `match`: of its name, with the groups fabric and trial.
    - `grippers`: the files of the grippers' paths.
    - `rig`, `frames`: the cameras of RGB-D images, and these; None, and files of clouds.
    """

    folder: Path
    scenario_name: str
    scenario: Scenario
    match: re.Match[str]
    grippers: list[Path]
    rig: Rig | None
    frames: Images | Frames

    @property
    def segmentation(self) -> Segmentation | None:
        """How the cloth is cut out: as cameras.json says, else as the scenario does."""
        return (self.rig and self.rig.segmentation) or self.scenario.segmentation


def find(folder: Path | str, manifest: Manifest, name: str) -> Found:
    """The recording of a name in a folder; raises as `read_recording`."""
    folder = Path(folder)
    known = list(manifest.scenarios.items())
    index, match = _matching(name, [scenario.folder for _, scenario in known], "scenarios")
    scenario_name, scenario = known[index]
    parts = {"name": name, "fabric": match["fabric"], "trial": match["trial"] or "1"}
    files = scenario.gripper.file
    for key, value in parts.items():
        files = files.replace(f"{{{key}}}", value)
    grippers = [folder / file.strip() for file in files.split(";")]
    rig = read_rig(folder / name) if find_rig(folder / name) else None
    found = folder / name, scenario_name, scenario, match, grippers, rig
    if rig is None:
        return Found(*found, find_frames(folder / name, READERS, scenario.first_frame))
    how = rig.segmentation or scenario.segmentation
    coloured = how is not None and how.colour is not None
    return Found(*found, find_images(folder / name, rig, scenario.frame_rate, coloured))


def sources(found: Found) -> list[Path]:
    """The files that a recording is read from, as far as they exist, sorted.

    Its manifest, the gripper's path, cameras.json, times, clouds or images; colour images only
    where a segmentation reads them.
    """
    folder, frames = found.folder, found.frames
    files = [manifest_of(folder.parent), find_rig(folder), folder / TABLE, *found.grippers]
    if isinstance(frames, Frames):
        files += frames.files
    else:
        files += [path for shots in frames.shots for shot in shots.values() for path in shot]
        files += [folder / name / TABLE for name in found.rig.cameras] if found.rig else []
    return sorted({path for path in files if path is not None and path.is_file()})


def read_recording(
    folder: Path | str,
    manifest: Manifest,
    name: str,
    watch: Watch = iter,
    cuts: list[FrameCuts] | None = None,
    found: Found | None = None,
) -> Recording:
    """The recording in `folder`/`name`, of clouds or of RGB-D images, in metres and seconds.

    Frames are read through `watch`, such as a bar that shows progress. What a segmentation does to
    each is appended to `cuts`. `found`: what `find` found, if it is known.

    `info.verified`: True if all its files have the values listed in the manifest, None if some are
    not listed; False, with a warning, if a listed one differs or is missing.

    Raises FileNotFoundError or a ValueError that names the file or folder.
    """
    found = found or find(folder, manifest, name)
    place, scenario, rig, frames = found.folder, found.scenario, found.rig, found.frames
    track, held = _held(found.grippers, scenario.gripper)
    shift, views = _in_session(scenario, name)

    def in_world(points: np.ndarray) -> np.ndarray:
        return to_world(scenario.cloud, points) + np.array(shift)

    if isinstance(frames, Images):
        times = frames.times
    else:
        times = times_of(place, frames, scenario.frame_rate)
    used = places_of(place, scenario.frames_used, frames.numbers)
    knots, start = _clocks(place, track, times, scenario)
    clock = knots - scenario.time_offset  # that of the frames
    cuts, segmenter = [] if cuts is None else cuts, None
    if (how := found.segmentation) is not None:
        known = how, scenario.sheet, scenario.table_height, held, clock, str(place), in_world
        segmenter = Segmenter(*known, used_times(times, used), cuts)
    info = RecordingInfo(
        name=name,
        scenario=found.scenario_name,
        fabric=found.match["fabric"],
        trial=found.match["trial"] or "1",
        source=str(place),
        frames_used=used,
        sheet=scenario.sheet,
        table_height=scenario.table_height,
        verified=None,
        time_offset=scenario.time_offset,
        doubt=scenario.doubt,
        views=views,
    )
    if rig is not None and isinstance(frames, Images):
        alone: list[dict[str, np.ndarray]] = []  # by camera
        times, clouds = read_clouds(place, rig, frames, watch, segmenter, alone)
        still = (times <= first_motion(clock, held).shown).tolist()
        info = with_cameras(info, rig, alone, np.isin(frames.times, times), still, in_world)
    else:
        assert isinstance(frames, Frames)
        clouds = read_frames(watch(frames.files))
        info = _verified(info, manifest, frames.files, clouds, found.grippers)
        if segmenter is not None:
            clouds = _cut_out(segmenter, frames.files, times, clouds)
        if scenario.drop_repeats:
            clouds = [_distinct(points) for points in clouds]
    if info.views is not None and segmenter is not None and cuts:  # what is cut off is not seen
        hidden = max(info.views.hidden, segmenter.how.gripper_radius)
        info = replace(info, views=replace(info.views, hidden=hidden))
    clouds = [in_world(points) for points in clouds]
    check_unit(place, clouds[0], scenario.sheet.size)
    times = times - start + scenario.time_offset
    try:
        return make_recording(clouds, times, held, knots - start, info)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def _clocks(folder: Path, track: Track, times: np.ndarray, scenario: Scenario):
    """The times of the path's knots on the clock of frames at `times`, [s], less the time offset;
    and when that of a recording begins."""
    knots, start = track.times, times[0] if times[0] > EPOCH else 0.0
    if knots is None:
        knots = start + np.arange(len(track.positions)) / scenario.gripper.rate
    else:
        start = knots[0]
    first, last = times[0] + scenario.time_offset, times[-1] + scenario.time_offset
    if last < knots[0] or first > knots[-1]:
        raise ValueError(
            f"{folder}: the frames go from {first:g} to {last:g} s, the gripper's path "
            f"from {knots[0]:g} to {knots[-1]:g} s: they are not on one clock; give their "
            "difference as time_offset [s]"
        )
    return knots, start


def _held(files: Sequence[Path], gripper: Gripper) -> tuple[Track, np.ndarray]:
    """The track of the grippers, and the places that they hold, in the world (knot, gripper, 3)."""
    tracks = [read_track(file, gripper.quaternion_order) for file in files]
    of_times = [track.times is not None for track in tracks]
    where = ", ".join(map(str, files))
    if any(of_times) and gripper.rate:
        raise ValueError(f"{where}: it has times, and the manifest a rate: leave the rate out")
    if not (any(of_times) or gripper.rate):
        raise ValueError(f"{where}: it has no times: give the gripper's rate [Hz]")
    turn, placed = np.array(gripper.transform.rotation), []
    for track in tracks:
        offset: np.ndarray | float = 0.0
        if any(gripper.tool_offset):
            try:
                track, offset = with_tool(track, gripper.tool_offset)
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from error
            offset = offset @ turn.T
        positions = to_world(gripper.transform, track.positions) + offset
        placed.append(track._replace(positions=positions))
    try:
        track = merged(placed)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return track, track.positions + np.array(gripper.offset)


def _cut_out(segmenter: Segmenter, files: Sequence[Path], times: Any, clouds: Any) -> list[Any]:
    """The clouds of files at times without what is not of the cloth; errors name the file."""
    kept = []
    for file, time, points in zip(files, times, clouds, strict=True):
        colours = () if segmenter.how.colour is None else read_colours(file)
        kept.append(points[segmenter(points, float(time), colours)])
    segmenter.check()
    return kept


def _matching(name: str, patterns: Sequence[str], kind: str) -> tuple[int, re.Match[str]]:
    """The one of some patterns that the name of a recording fits, by its number."""
    matches = [re.fullmatch(pattern, name) for pattern in patterns]
    fits = [(index, match) for index, match in enumerate(matches) if match]
    if len(fits) != 1:
        raise ValueError(f"{name!r} fits {len(fits)} {kind}, expected one of: {list(patterns)}")
    return fits[0]


def _in_session(scenario: Scenario, name: str) -> tuple[Vector, Views | None]:
    """The shift of a recording's clouds [m], and the views with it."""
    if not scenario.sessions:
        return (0.0, 0.0, 0.0), scenario.views
    patterns = [session.recordings for session in scenario.sessions]
    session, views = scenario.sessions[_matching(name, patterns, "sessions")[0]], scenario.views
    if views is not None:
        box = session.workspace or views.clean.workspace
        views = replace(views, clean=replace(views.clean, workspace=box))
        views = shifted(views, session.shift)
    return session.shift, views


def _verified(
    info: RecordingInfo,
    manifest: Manifest,
    files: Sequence[Path],
    clouds: Sequence[np.ndarray],
    paths: Sequence[Path],
) -> RecordingInfo:
    """With whether clouds and the grippers' paths are those listed in a manifest."""
    values = {f"{info.name}/{f.name}": c for f, c in zip(files, clouds, strict=True)}
    values |= {f.name: read_values(f) for f in paths if f.suffix == ".npy"}
    listed = manifest.files
    differ = [f for f, v in values.items() if f in listed and hash_values(v) != listed[f]]
    differ += [f for f in listed if f.startswith(f"{info.name}/") and f not in values]
    if differ:
        words = f"{info.name}: not the published values, or missing: {', '.join(differ)}"
        warnings.warn(words, stacklevel=3)
        return replace(info, verified=False)
    if not values.keys() <= listed.keys():
        return info
    source = manifest.source
    words = f"{source.repository} {source.commit} {source.path}"
    return replace(info, verified=True, source=words)


def _distinct(points: np.ndarray) -> np.ndarray:
    """One of points that are equal; all where they are too many, which `check` counts."""
    kept = at_one_place(points)
    kept[np.unique(points, axis=0, return_index=True)[1]] = True
    return points[kept]
