"""Swings: a sheet that hangs from a bar on the tool of an arm, tracked as a grid of points.

The layout is that of `data_manifests/swings.json`: in one NPZ a recording, the tracked points in
the robot's frame on the tracker's clock, and the measured pose of the tool on the arm's.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from r2s._util.files import read_npz
from r2s.recordings.recording import (
    MeasurementUncertainty,
    Recording,
    RecordingInfo,
    SheetPlacement,
    make_recording,
)

ARRAYS = ("times", "points", "tool_times", "tool_position", "tool_quaternion_xyzw")
INTERVAL = 0.1  # [s], between frames
LONGEST_GAP = 0.5  # [s], of the tracker, at which a recording ends
FLOOR = 1.0  # [m], below all that was seen: the sheet hangs freely
TURN_DEVIATION = 0.02  # [rad], of the tracker's frame against the arm's
UNIT = 1e-3  # a quaternion's length is 1, but for this

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Bar:
    """How the sheet is held, and how it was tracked.

    - `ends`: of the bar, in the frame of the tool, [m]; the warp runs from the first to the second.
    - `drop`: length of the sheet below it, [m].
    - `lag`: of the tracker's clock behind the arm's, [s]. `lag_deviation`: between recordings, [s].
    - `place_deviation`: of the bar in the frame of the tool, [m].
    - `tracker_error`: deviation of a coordinate [m] at rest, of each row from the bar down.

    Raises ValueError for ends that are one, and lengths or deviations that are not positive.
    """

    ends: tuple[Vector, Vector]
    drop: float
    lag: float
    lag_deviation: float
    place_deviation: float
    tracker_error: tuple[float, ...]
    note: str

    def __post_init__(self) -> None:
        if not self.length > 0:
            raise ValueError(f"the ends of the bar must differ, found {self.ends}")
        numbers = (self.drop, self.lag_deviation, self.place_deviation, *self.tracker_error)
        if not min(numbers) > 0:
            raise ValueError(f"drop and deviations must be positive, found {numbers}")

    @property
    def length(self) -> float:
        """Of the bar, [m]."""
        return float(np.linalg.norm(np.subtract(*self.ends)))


def is_swing(path: Path) -> bool:
    """Whether a file is an NPZ that has the pose of a tool."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return "tool_position" in file
    except Exception:  # it is something else, which its own reader will say
        return False


def read_swing(path: Path | str, bar: Bar, duration: float | None = None) -> Recording:
    """The recording of a swing, on the clock of the arm, every `INTERVAL`; z up, in metres.

    Markers are the tracked points, interpolated between the tracker's frames. Where it lost the
    whole sheet for longer than `LONGEST_GAP` the recording ends, with a warning. `duration` [s]
    from the first frame on; None: all.

    Raises FileNotFoundError, or a ValueError that names the file and what is wrong with its arrays,
    the bar, or the duration.
    """
    path = Path(path)
    try:
        return _recording(path.stem, _read(path), bar, duration)
    except ValueError as error:
        raise ValueError(f"{path}: no readable swing: {error}") from error


def bar_path(
    position: Float[np.ndarray, "sample 3"], quaternion: Float[np.ndarray, "sample 4"], bar: Bar
) -> Float[np.ndarray, "sample 2 3"]:
    """The ends of the bar [m] at poses of the tool: position [m], quaternion (x, y, z, w)."""
    turn = Rotation.from_quat(quaternion)
    return np.stack([position + turn.apply(end) for end in bar.ends], axis=1)


def _read(path: Path) -> dict[str, np.ndarray]:
    found = read_npz(path, *ARRAYS)
    arrays = {name: np.asarray(found[name], np.float64) for name in ARRAYS}
    points, frames = arrays["points"], len(arrays["times"])
    if points.ndim != 4 or points.shape[0] != frames or points.shape[3] != 3:
        raise ValueError(
            f"points must be ({frames}, along the bar, down, 3) [m], found {points.shape}"
        )
    for name, count in (("tool_position", 3), ("tool_quaternion_xyzw", 4)):
        if arrays[name].shape != (len(arrays["tool_times"]), count):
            raise ValueError(
                f"{name} must be {(len(arrays['tool_times']), count)}, found {arrays[name].shape}"
            )
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} is not finite")
    lengths = np.linalg.norm(arrays["tool_quaternion_xyzw"], axis=1)
    if np.abs(lengths - 1).max() > UNIT:
        raise ValueError(
            f"quaternions must have length 1, found {lengths.min()} to {lengths.max()}"
        )
    for name in ("times", "tool_times"):
        if not (np.diff(arrays[name]) >= 0).all():
            raise ValueError(f"{name} must increase [s]")
    return arrays


def _recording(
    name: str, arrays: dict[str, np.ndarray], bar: Bar, duration: float | None
) -> Recording:
    # some poses are logged twice at one time
    tool = np.flatnonzero(np.diff(arrays["tool_times"], prepend=-np.inf) > 1e-4)
    path = bar_path(arrays["tool_position"][tool], arrays["tool_quaternion_xyzw"][tool], bar)
    clock = arrays["tool_times"][tool]
    seen_at = arrays["times"] - bar.lag
    end = min(_first_gap(name, seen_at, arrays["points"]), clock[-1])
    if duration is not None:
        end = min(end, seen_at[0] + duration)
    times = np.arange(seen_at[0], end, INTERVAL)
    if len(times) < 2:
        raise ValueError(f"{len(times)} frames every {INTERVAL} s: the duration must be longer")
    markers, seen = _resampled(times, seen_at, arrays["points"])
    times = times - seen_at[0]  # single precision is finest near 0
    across = arrays["points"].shape[1:3]
    sides = (np.linspace(0, *side) for side in zip((bar.length, bar.drop), across, strict=True))
    places = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    place = bar.place_deviation
    info = RecordingInfo(
        name=name,
        scenario="swing",
        fabric=name,
        trial="1",
        source=name,
        frames_used=(0, len(times) - 1),
        sheet=_sheet(path[0], bar),
        table_height=float(np.nanmin(arrays["points"][..., 2]) - FLOOR),
        verified=None,
        time_offset=-bar.lag,
        doubt=MeasurementUncertainty((place, place, place), TURN_DEVIATION, bar.lag_deviation),
    )
    return make_recording(
        None,
        times,
        path,
        clock - seen_at[0],
        info,
        markers=markers,
        markers_seen=seen,
        marker_places=places,
    )


def _first_gap(name: str, seen_at: np.ndarray, points: np.ndarray) -> float:
    """The end, or where the tracker lost the whole sheet for longer than `LONGEST_GAP`, [s]."""
    tracked = seen_at[np.isfinite(points.reshape(len(points), -1)).any(axis=1)]
    gaps = np.flatnonzero(np.diff(tracked) > LONGEST_GAP)
    if not len(gaps):
        return float(tracked[-1])
    lost, found = tracked[gaps[0]] - seen_at[0], tracked[gaps[0] + 1] - seen_at[0]
    warnings.warn(
        f"{name}: the tracker lost the sheet from {lost:.2f} to {found:.2f} s: it is read until "
        f"then, of {seen_at[-1] - seen_at[0]:.2f} s",
        stacklevel=4,
    )
    return float(tracked[gaps[0]])


def _resampled(
    times: Float[np.ndarray, " frame"],
    seen_at: Float[np.ndarray, " tracked"],
    points: Float[np.ndarray, "tracked along down 3"],
) -> tuple[np.ndarray, np.ndarray]:
    """Points at other times, linear between the tracker's frames, and which of them were seen."""
    after = np.clip(np.searchsorted(seen_at, times, side="right"), 1, len(seen_at) - 1)
    gap = seen_at[after] - seen_at[after - 1]
    share = ((times - seen_at[after - 1]) / np.maximum(gap, 1e-9))[:, None, None, None]
    moved = (1 - share) * points[after - 1] + share * points[after]
    exact = np.where(share == 0, points[after - 1], moved)
    flat = exact.reshape(len(times), -1, 3)
    seen = np.asarray(np.isfinite(flat).all(axis=-1))
    return np.where(seen[..., None], flat, 0), seen


def _sheet(ends: Float[np.ndarray, "2 3"], bar: Bar) -> SheetPlacement:
    """The sheet at rest below a level bar at one end of this one, [m]."""
    along = (ends[1] - ends[0]) * [1, 1, 0]
    if not np.linalg.norm(along) > 0.5 * bar.length:
        raise ValueError(
            f"the bar must be about level, found its ends at {ends[0]} and {ends[1]} m"
        )
    x, y, _ = (along / np.linalg.norm(along)).tolist()
    origin: Vector = tuple(ends[0].tolist())  # pyright: ignore[reportAssignmentType]
    size = (bar.length, bar.drop)
    return SheetPlacement(size, origin, (x, y, 0.0), (0.0, 0.0, -1.0), ("origin", "warp"))
