"""The canonical observation of a fabric: point clouds and the path of what holds the cloth."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s._util.checks import shown
from r2s._util.files import parse, read_npz, write_npz
from r2s._util.units import positive
from r2s.recordings.clouds import draw_points, numbers, voxel_means
from r2s.recordings.views import CameraFit, Views

FORMAT = "r2s-recording/5"
# the first knew neither force nor markers nor wind, the second neither doubt nor views, the third
# no fits of cameras, the fourth not which camera took a frame
READABLE = tuple(f"r2s-recording/{version}" for version in range(1, 6))
CORNERS = {"origin": (0, 0), "warp": (1, 0), "weft": (0, 1), "opposite": (1, 1)}
OPTIONAL = ("force", "force_times", "markers", "markers_seen", "marker_places")
PATH = ("knot", "gripper", 3)
STILL = 2e-3  # [m]: a gripper that goes farther than this moves; at rest robots jitter by less
JITTER, FEWEST = 4.0, 10  # standard deviations of it, within which knots are at rest; of so many
EXACT = 1e-6  # [m], the same of a path without jitter
MAX_STEP = 0.025  # [s]: 1 mm from the limit of small steps in a lift of 2.5 s, by measurement
CLOCK_TOLERANCE = 1e-6  # [s], rounding when a time is a frame number over a rate


@dataclass(frozen=True)
class SheetPlacement:
    """Where the rectangular sheet lies at rest, in metres, z up.

    `pinned` names the corner of each gripper: "origin", "warp" (at the end of the warp side),
    "weft" or "opposite".
    """

    size: tuple[float, float]  # [m], lengths of the warp and the weft side
    origin: tuple[float, float, float]  # [m], world position of the rest corner (0, 0)
    warp: tuple[float, float, float]  # unit vector, world direction of the warp side
    weft: tuple[float, float, float]  # unit vector, world direction of the weft side
    pinned: tuple[str, ...]
    former: ClassVar[dict[str, str]] = {"held": "pinned"}  # names in files of before 0.4

    def __post_init__(self) -> None:
        if np.shape(self.size) != (2,):
            raise ValueError(f"sheet: size must be (warp, weft) [m], found {self.size}")
        if not all(np.isfinite(side) and side > 0 for side in self.size):
            raise ValueError(f"sheet: sides must be positive [m], found {self.size}")
        if not np.isfinite(self.origin).all():
            raise ValueError(f"sheet: origin must be finite [m], found {self.origin}")
        axes = np.array([self.warp, self.weft])
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-6):
            raise ValueError(f"sheet: warp and weft must be orthonormal, found {axes.tolist()}")
        for name in set(self.pinned) - CORNERS.keys():
            raise ValueError(f"sheet: unknown corner {name!r}, expected one of {list(CORNERS)}")


def corner(sheet: SheetPlacement, name: str) -> Float[np.ndarray, "3"]:
    """The world position [m] of a corner at rest; `name` is a key of CORNERS (else KeyError)."""
    along_warp, along_weft = CORNERS[name]
    warp, weft = np.array(sheet.warp) * sheet.size[0], np.array(sheet.weft) * sheet.size[1]
    return np.array(sheet.origin) + along_warp * warp + along_weft * weft


@dataclass(frozen=True)
class MeasurementUncertainty:
    """Standard deviations of what was written down of a recording; 0: it is exact.

    - `shift`: of the cameras' frame against that of the grippers along x, y and z, [m].
    - `turn`: of the same about the vertical, [rad].
    - `time`: of the cameras' clock against that of the grippers, [s].
    - `size`: of the sheet's side length, relative.
    - `air`: of the force of the air at its speed (its drag coefficient), relative; 0: exact, but
      for a wind that blows, whose force an estimate always doubts.
    """

    shift: tuple[float, float, float]
    turn: float
    time: float = 0.0
    size: float = 0.0
    air: float = 0.0

    def __post_init__(self) -> None:
        values = np.array([*self.shift, self.turn, self.time, self.size, self.air])
        if not (np.isfinite(values) & (values >= 0)).all():
            raise ValueError(f"doubt: standard deviations must not be negative, found {self}")


@dataclass(frozen=True)
class RecordingInfo:
    """What a recording is of.

    - `wind`: of the air around the sheet; None: not measured.
    - `time_offset`: added to the cameras' clock to give `Recording.times`; negative where the
      cameras lag behind the grippers. `set_time_offset` changes it.
    - `doubt`: standard deviations of all this; `views`: the cameras; None: unknown.
    - `camera_fits`: what each depth camera shows alone, of RGB-D images; found at conversion.
    - `angle`: from the pull of a stretching to the warp: 45 on the bias, 90 along the weft.
    """

    name: str
    scenario: str
    fabric: str
    trial: str
    source: str
    frames_used: tuple[int, int]  # inclusive
    sheet: SheetPlacement
    table_height: float  # [m]
    verified: bool | None  # do the files match published hashes (None: there are none)
    wind: tuple[float, float, float] | None = None  # [m/s]
    time_offset: float = 0.0  # [s]
    doubt: MeasurementUncertainty | None = None
    views: Views | None = None
    angle: float = 0.0  # [degrees]
    camera_fits: tuple[CameraFit, ...] = ()

    def __post_init__(self) -> None:
        if self.wind is not None and (len(self.wind) != 3 or not np.isfinite(self.wind).all()):
            raise ValueError(f"wind must be three finite numbers [m/s], found {self.wind}")
        for name, unit in (("time_offset", "s"), ("angle", "degrees")):
            if not np.isfinite(value := getattr(self, name)):
                raise ValueError(f"{name} must be finite [{unit}], found {value}")
        if self.angle and self.scenario != "stretching":
            raise ValueError(
                f"angle is that of a stretching to the warp, found {self.angle} degrees for "
                f"{self.scenario!r}: other motions have the sheet's sides along warp and weft"
            )


class Recording(eqx.Module):
    """The canonical observation of a fabric, in metres and seconds, z up.

    `info` is static: a jitted function that takes a whole Recording compiles once per `info`; one
    that takes its arrays compiles once per shape (see `subsample`).

    `force` is what pulls at the sheet: numbers, or vectors in the world. `markers` are places
    printed on it; `marker_places` says where on it, None: where the first frame shows them on the
    sheet at rest. None where not recorded.
    """

    points: Float[Array, "frame point 3"]  # [m], padded with zeros; only where mask
    mask: Bool[Array, "frame point"]
    times: Float[Array, " frame"]  # [s], on the clock of gripper_times
    gripper_path: Float[Array, "knot gripper 3"]  # [m], held still before the first knot
    gripper_times: Float[Array, " knot"]  # [s]
    info: RecordingInfo = eqx.field(static=True)
    force: Float[Array, " sample"] | Float[Array, "sample 3"] | None = None  # [N]
    force_times: Float[Array, " sample"] | None = None  # [s], on the clock of gripper_times
    markers: Float[Array, "frame marker 3"] | None = None  # [m], zero where not markers_seen
    markers_seen: Bool[Array, "frame marker"] | None = None
    marker_places: Float[Array, "marker 2"] | None = None  # [m], along warp and weft


def make_recording(
    clouds: Sequence[Any] | None,
    times: Any,
    gripper_path: Any,
    gripper_times: Any,
    info: RecordingInfo,
    *,
    force: Any = None,
    force_times: Any = None,
    markers: Any = None,
    markers_seen: Any = None,
    marker_places: Any = None,
) -> Recording:
    """Pad ragged clouds into a Recording, in JAX's default precision.

    - `clouds`: one (point, 3) array per frame, [m]; None: the markers that are seen.
    - `times`: (frame,), `info.time_offset` included, [s].
    - `gripper_path`: (knot, gripper, 3), or (knot, 3) for one gripper, [m]. `gripper_times`: [s].
    - `force`, `force_times`: (sample,) or (sample, 3) [N], and (sample,) [s].
    - `markers`: (frame, marker, 3), [m]. `markers_seen`: (frame, marker); None: where finite.
    - `marker_places`: (marker, 2), where they are on the sheet along warp and weft, [m].

    Raises ValueError that names the recording, and the frame where there is one: arrays that are
    empty or not finite, do not increase, end too early, or do not belong together.
    """
    try:
        markers, markers_seen = _check_markers(markers, markers_seen)
        if clouds is None:
            pairs = () if markers is None else zip(markers, markers_seen, strict=True)
            clouds = [places[seen] for places, seen in pairs]
        clouds = [
            numbers(f"frame {frame}: the cloud", cloud, "point", 3)
            for frame, cloud in enumerate(clouds)
        ]
        first, last = info.frames_used
        if not 0 <= first <= last < len(clouds):
            raise ValueError(
                f"frames_used is {first}..{last}, but there are {len(clouds)} frames: they count "
                "from 0, the last one included"
            )
        if info.views and len(info.views.taken) not in (0, len(clouds)):
            raise ValueError(f"views: taken has {len(info.views.taken)} of {len(clouds)} frames")
        if markers is not None and len(markers) != len(clouds):
            raise ValueError(f"markers in {len(markers)} frames, but clouds in {len(clouds)}")
        if marker_places is not None:
            marker_places = _check_places(marker_places, markers, info.sheet.size)
        path = _check_path(gripper_path, info.sheet.pinned)
        times = _check_times("times", times, len(clouds))
        knots = _check_times("gripper_times", gripper_times, len(path))
        _check_end(knots, times)
        if (force is None) != (force_times is None):
            raise ValueError("force and force_times: one is missing, give both or neither")
        if force is not None:
            vector = (3,) if np.ndim(force) > 1 else ()
            force = numbers("force [N]", force, "sample", *vector)
            force_times = _check_times("force_times", force_times, len(force))
    except ValueError as error:
        raise ValueError(f"recording {info.name}: {error}") from error
    points, mask = _pad(clouds, max(map(len, clouds)))
    return Recording(
        points=jnp.asarray(points, float),
        mask=jnp.asarray(mask),
        times=jnp.asarray(times, float),
        gripper_path=jnp.asarray(path, float),
        gripper_times=jnp.asarray(knots, float),
        info=info,
        force=_floats(force),
        force_times=_floats(force_times),
        markers=_floats(markers),
        markers_seen=None if markers_seen is None else jnp.asarray(markers_seen),
        marker_places=_floats(marker_places),
    )


def set_time_offset(recording: Recording, offset: float) -> Recording:
    """The recording with another offset [s] between the cameras' clock and that of the grippers.

    Markers move with the frames, the force does not. Raises ValueError when the last frame comes
    after the end of the gripper path.
    """
    info = replace(recording.info, time_offset=offset)
    times = np.asarray(recording.times, np.float64) + (offset - recording.info.time_offset)
    try:
        _check_end(np.asarray(recording.gripper_times), times)
    except ValueError as error:
        raise ValueError(f"recording {info.name}: time offset {offset:g} s: {error}") from error
    return replace(recording, times=jnp.asarray(times, float), info=info)


def cloud(recording: Recording, frame: int) -> Float[np.ndarray, "point 3"]:
    """The points [m] of one frame, without the padding; IndexError if there is no such frame."""
    return np.asarray(recording.points)[frame][np.asarray(recording.mask)[frame]]


def clouds_are_markers(recording: Recording) -> bool:
    """Whether markers were put in the place of clouds that nobody recorded."""
    markers = recording.markers
    return markers is not None and recording.points.shape[1] <= markers.shape[1]


def gripper_positions(recording: Recording) -> Float[np.ndarray, "frame gripper 3"]:
    """Where the grippers are at the frames [m]: linear between knots, at rest before and after."""
    arrays = recording.times, recording.gripper_times, recording.gripper_path
    return interpolated(*(np.asarray(array, np.float64) for array in arrays))


class FirstMotion(NamedTuple):
    """When grippers begin to move, [s]: `begin`, the last knot at rest, and `shown`, when the first
    of them is `STILL` from where it was. Infinite where none goes so far."""

    begin: float
    shown: float


def first_motion(
    knots: Float[np.ndarray, " knot"], path: Float[np.ndarray, "knot gripper 3"]
) -> FirstMotion:
    """The first motion of the grippers along a path [m] with knots at some times [s].

    Any that goes farther than `STILL` counts, however slow, and from its begin on. What a robot
    jitters at rest does not: its deviation is that of knots from a smooth motion.
    """
    away = np.linalg.norm(path - path[0], axis=-1).max(axis=1)
    if not (away > STILL).any():
        return FirstMotion(np.inf, np.inf)
    end = int(np.argmax(away > STILL))  # not 0: the path begins there
    shown = np.interp(STILL, away[end - 1 : end + 1], knots[end - 1 : end + 1])
    jitter = 0.0
    if end >= FEWEST:
        off, times = path[:end], knots[:end]
        for _ in range(2):  # from the middle of the neighbours: twice, a steady acceleration is 0
            steps = np.diff(times)
            share = (steps[:-1] / (steps[:-1] + steps[1:]))[:, None, None]
            off = off[1:-1] - off[:-2] - share * (off[2:] - off[:-2])
            times = times[1:-1]
        # (1 + 16 + 36 + 16 + 1) / 16 of the variance; of three axes the median of the sum is 2.366
        square = np.median(np.sum(off**2, axis=-1), axis=0).max()
        jitter = float(np.sqrt(square / (70 / 16 * 2.366)))
    rest = np.flatnonzero(away[:end] <= max(JITTER * jitter, EXACT))
    return FirstMotion(float(knots[rest[-1]]), float(shown))


def at_rest(recording: Recording) -> Bool[np.ndarray, " frame"]:
    """Which frames show the sheet before the grippers' first motion."""
    knots, path = np.asarray(recording.gripper_times), np.asarray(recording.gripper_path)
    return np.asarray(recording.times) <= first_motion(knots, path).shown


def interpolated(
    times: Float[np.ndarray, " time"],
    knots: Float[np.ndarray, " knot"],
    values: Float[np.ndarray, "knot ..."],
) -> Float[np.ndarray, "time ..."]:
    """Values at knots [s], at other times [s]: linear between knots, constant before and after."""
    columns = values.reshape(len(values), -1).T
    between = np.stack([np.interp(times, knots, column) for column in columns], axis=1)
    return between.reshape(-1, *values.shape[1:])


def frame_durations(times: Float[np.ndarray, " frame"]) -> Float[np.ndarray, " frame"]:
    """How long [s] each frame lasts when they are played: until the next, the last as most do."""
    gaps = np.diff(times)
    return np.append(gaps, np.median(gaps) if len(gaps) else 1.0)


def check_covered(clock: Float[np.ndarray, " sample"], times: Float[np.ndarray, " frame"]) -> None:
    """Raise `ValueError` where a log of a force at the times `clock` [s] begins later, or ends
    earlier, than frames at `times` [s], by more than a frame."""
    slack = float(np.diff(times).mean()) if len(times) > 1 else 0.0
    if clock[0] > times[0] + slack or clock[-1] < times[-1] - slack:
        raise ValueError(
            f"the force is known from {clock[0]:g} to {clock[-1]:g} s, the frames that count go "
            f"from {times[0]:g} to {times[-1]:g} s: is it on the same clock?"
        )


def subsample(recording: Recording, num_points: int, voxel: float | None, seed: int) -> Recording:
    """Thin every frame to at most `num_points`, padded to exactly that many.

    Drawn by a generator seeded with (`seed`, frame). With a `voxel` the points of each cube of that
    side [m] become their mean first, which evens out their density, but moves them.
    Recordings of as many frames and knots then have the same shapes. Raises ValueError if
    `num_points` < 1 or `voxel` is not positive.
    """
    if num_points < 1:
        raise ValueError(f"num_points must be at least 1, found {num_points}")
    if voxel is not None:
        positive("m", voxel=voxel)
    thinned = []
    for frame in range(len(recording.times)):
        points = cloud(recording, frame)
        points = points if voxel is None else voxel_means(points, voxel)
        thinned.append(draw_points(points, num_points, (seed, frame)))
    points, mask = _pad(thinned, num_points)
    return replace(recording, points=jnp.asarray(points, float), mask=jnp.asarray(mask))


def save(recording: Recording, path: Path | str) -> None:
    """Write the recording to `path` as one NPZ, whole or not at all; OSError names `path`.

    Arrays: `points` (all frames', 3) and `offsets` (frame + 1), where frame i is
    `points[offsets[i]:offsets[i + 1]]`; `times`, `gripper_path`, `gripper_times`; where recorded
    `force`, `force_times`, `markers`, `markers_seen`; `meta`: JSON of format and `info`.
    """
    mask = np.asarray(recording.mask)
    names = ("times", "gripper_path", "gripper_times", *OPTIONAL)
    arrays = {name: getattr(recording, name) for name in names}
    write_npz(
        path,
        meta=json.dumps({"format": FORMAT, "info": asdict(recording.info)}),
        points=np.asarray(recording.points)[mask],
        offsets=np.cumsum([0, *mask.sum(axis=1)]),
        **{name: values for name, values in arrays.items() if values is not None},
    )


def load(path: Path | str) -> Recording:
    """Read what `save` wrote, in this version of the format or an earlier one.

    Raises FileNotFoundError, or a ValueError that names the file and what is wrong with it.
    """
    try:
        stored = read_npz(path, "meta", "points", "offsets", "times", text="meta")
        # "handle" was the gripper before 0.4
        arrays = {name.replace("handle_", "gripper_"): part for name, part in stored.items()}
        meta = json.loads(str(arrays["meta"]))
        form = meta.get("format") if isinstance(meta, dict) else meta
        if form not in READABLE:
            raise ValueError(
                f"format {shown(form)}, expected one of {READABLE}: update r2s, or convert "
                "the recording again"
            )
        return make_recording(
            _split(arrays["points"], arrays["offsets"]),
            arrays["times"],
            arrays["gripper_path"],
            arrays["gripper_times"],
            parse(RecordingInfo, meta["info"], "info"),
            **{name: arrays[name] for name in OPTIONAL if name in arrays},
        )
    except (KeyError, ValueError, RecursionError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else f"{error}"
        raise ValueError(f"{path}: not a readable recording ({FORMAT}): {reason}") from error


def _split(points: np.ndarray, offsets: np.ndarray) -> list[np.ndarray]:
    if points.ndim != 2:
        raise ValueError(f"points must have the shape (point, 3), found {points.shape}")
    ends = [0, len(points)]
    numbered = offsets.ndim == 1 and offsets.size and offsets.dtype.kind in "iu"
    if not numbered or list(offsets[[0, -1]]) != ends or (np.diff(offsets) < 0).any():
        raise ValueError(
            f"offsets must rise from 0 to the number of points, {ends[1]}, one more than frames, "
            f"found {shown(offsets.tolist())}"
        )
    return np.split(points, offsets[1:-1])


def _check_places(places: Any, markers: Any, size: tuple[float, float]) -> np.ndarray:
    if markers is None:
        raise ValueError("marker_places without markers")
    places = numbers("marker_places [m]", places, markers.shape[1], 2)
    if not ((places >= -CLOCK_TOLERANCE) & (places <= np.array(size) + CLOCK_TOLERANCE)).all():
        raise ValueError(
            f"marker_places must lie on the sheet of {size} m, found {places.min(axis=0)} to "
            f"{places.max(axis=0)}: in metres from its origin, along warp and weft"
        )
    return places


def _check_times(what: str, times: Any, count: int) -> np.ndarray:
    times = numbers(f"{what} [s]", times, count)
    # as they will be kept: in single precision, times of a clock that counts from 1970 are equal
    kept = np.asarray(jnp.asarray(times, float))
    for at in np.flatnonzero(np.diff(kept) <= 0)[:1]:
        raise ValueError(
            f"{what} must increase: {times[at]} s at {at}, then {times[at + 1]} s, "
            f"as {kept.dtype} {kept[at]} and {kept[at + 1]}; sort them, drop repeated ones, and "
            "count from the start of the recording"
        )
    return times


def _check_end(knots: np.ndarray, times: np.ndarray) -> None:
    if knots[-1] < times[-1] - MAX_STEP:  # within a step the grippers stay where they are
        raise ValueError(
            f"the gripper path ends at {knots[-1]:g} s, before the last frame at {times[-1]:g} s: "
            "log it longer, leave the last frames out, or correct the time offset"
        )


def _check_markers(markers: Any, seen: Any) -> tuple[Any, Any]:
    """Markers, zero where they are not seen, and where they are; None and None for none."""
    if markers is None:
        if seen is not None:
            raise ValueError("markers_seen without markers")
        return None, None
    markers = np.asarray(markers, np.float64)
    if markers.ndim != 3 or markers.shape[2] != 3:
        raise ValueError(f"markers must be (frame, marker, 3) [m], found {markers.shape}")
    finite = np.isfinite(markers).all(axis=2)
    seen = finite if seen is None else np.asarray(seen)
    if seen.dtype != bool or seen.shape != finite.shape:
        raise ValueError(
            f"markers_seen must be {finite.shape} of bool, found {seen.shape} of {seen.dtype}"
        )
    for frame, marker in np.argwhere(seen & ~finite)[:1]:
        raise ValueError(f"frame {frame}: marker {marker} is seen, but its place is not finite")
    return np.where(seen[..., None], markers, 0), seen


def _check_path(path: Any, pinned: tuple[str, ...]) -> np.ndarray:
    path = np.asarray(path, np.float64)
    path = numbers("the gripper path [m]", path[:, None] if path.ndim == 2 else path, *PATH)
    if path.shape[1] != len(pinned):
        raise ValueError(f"the path has {path.shape[1]} grippers, the sheet is pinned at {pinned}")
    return path


def _floats(values: Any) -> Array | None:
    return None if values is None else jnp.asarray(values, float)


def _pad(clouds: Sequence[np.ndarray], width: int) -> tuple[np.ndarray, np.ndarray]:
    points = np.zeros((len(clouds), width, 3))
    mask = np.arange(width) < np.array([len(cloud) for cloud in clouds])[:, None]
    points[mask] = np.concatenate(clouds)
    return points, mask
