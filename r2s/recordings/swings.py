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
from r2s._util.units import positive
from r2s.recordings.clouds import numbers
from r2s.recordings.recording import (
    MeasurementUncertainty,
    Recording,
    RecordingInfo,
    SheetPlacement,
    interpolated,
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
    """

    ends: tuple[Vector, Vector]
    drop: float
    lag: float
    lag_deviation: float
    place_deviation: float
    tracker_error: tuple[float, ...]
    note: str

    def __post_init__(self) -> None:
        positive("m", length=self.length, drop=self.drop, place_deviation=self.place_deviation)
        positive("s", lag_deviation=self.lag_deviation)
        positive("m", tracker_error=min(self.tracker_error))

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

    Raises FileNotFoundError, or a ValueError that names the file and what is wrong with it.
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
    stored = read_npz(path, *ARRAYS)
    points, frames, samples = stored["points"], stored["times"].size, stored["tool_times"].size
    if points.ndim != 4 or len(points) != frames or points.shape[3] != 3:
        raise ValueError(
            f"points must be ({frames}, along the bar, down, 3) [m], found {points.shape}"
        )
    shapes = {
        "times": ("frame",),
        "tool_times": ("sample",),
        "tool_position": (samples, 3),
        "tool_quaternion_xyzw": (samples, 4),
    }
    arrays = {name: numbers(name, stored[name], *shape) for name, shape in shapes.items()}
    lengths = np.linalg.norm(arrays["tool_quaternion_xyzw"], axis=1)
    if np.abs(lengths - 1).max() > UNIT:
        raise ValueError(
            f"quaternions must have length 1, found {lengths.min()} to {lengths.max()}"
        )
    for name in ("times", "tool_times"):
        if not (np.diff(arrays[name]) >= 0).all():
            raise ValueError(f"{name} must increase [s]")
    return arrays | {"points": np.asarray(points, np.float64)}


def _recording(
    name: str, arrays: dict[str, np.ndarray], bar: Bar, duration: float | None
) -> Recording:
    # some poses are logged twice at one time
    tool = np.flatnonzero(np.diff(arrays["tool_times"], prepend=-np.inf) > 1e-4)
    path = bar_path(arrays["tool_position"][tool], arrays["tool_quaternion_xyzw"][tool], bar)
    clock = arrays["tool_times"][tool]
    tracked_at = arrays["times"] - bar.lag
    start = tracked_at[0]
    end = min(_first_gap(name, tracked_at, arrays["points"]), clock[-1])
    if duration is not None:
        end = min(end, start + duration)
    times = np.arange(start, end, INTERVAL)
    if len(times) < 2:
        raise ValueError(f"{len(times)} frames every {INTERVAL} s: the duration must be longer")
    shape = arrays["points"].shape[1:3]
    markers = interpolated(times, tracked_at, arrays["points"]).reshape(len(times), -1, 3)
    sides = (np.linspace(0, *side) for side in zip((bar.length, bar.drop), shape, strict=True))
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
        times - start,  # single precision is finest near 0
        path,
        clock - start,
        info,
        markers=markers,  # NaN beside frames in which the tracker lost them
        marker_places=np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2),
    )


def _first_gap(name: str, tracked_at: np.ndarray, points: np.ndarray) -> float:
    """The end, or where the tracker lost the whole sheet for longer than `LONGEST_GAP`, [s]."""
    tracked = tracked_at[np.isfinite(points.reshape(len(points), -1)).any(axis=1)]
    for gap in np.flatnonzero(np.diff(tracked) > LONGEST_GAP)[:1]:
        begin, end = tracked[gap : gap + 2] - tracked_at[0]
        warnings.warn(
            f"{name}: the tracker lost the sheet from {begin:.2f} to {end:.2f} s: it is read until "
            f"then, of {tracked_at[-1] - tracked_at[0]:.2f} s",
            stacklevel=4,
        )
        return float(tracked[gap])
    return float(tracked[-1])


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
