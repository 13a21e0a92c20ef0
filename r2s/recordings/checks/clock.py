"""Do the frames come when they should, and when the grippers move?"""

import numpy as np
from jaxtyping import Float

from r2s.recordings.checks.finding import Finding
from r2s.recordings.checks.seen import FEWEST, Points, Seen, lies
from r2s.recordings.recording import Recording

LAGS = np.arange(-50, 51) / 100  # [s], that are tried
RATES = np.array([0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0])  # of the clock, that are tried
CLEARLY = 0.25  # of what is left as written: then another lag or rate is better
SCALE = 0.1  # of the cameras
TOP = 0.99  # quantile of height from which points are the top
FRAMES = 5  # at least, that show the sheet held up
NEAR = 6e-3  # [m], within which the tops follow the grippers where nothing is wrong
MOVES = 0.05  # [m], at least, along an axis that is compared
UP = 0.1  # [m] above the table: a sheet that is held up


def check_clock(seen: Seen) -> list[Finding]:
    """Intervals, rate, the grippers' speed, and how late the top of the cloud follows them."""
    gaps = np.diff(np.asarray(seen.recording.times, np.float64))
    middle = float(np.median(gaps)) if len(gaps) else np.nan
    uneven = float(np.abs(gaps / middle - 1).max()) if len(gaps) else np.nan
    lag, rate = _lag(seen)
    why = "" if np.isfinite(lag) else "the tops of the clouds do not show it"
    return [
        Finding.make("frames", uneven),
        Finding.make("rate", 1 / middle),
        Finding.make("grippers", _speed(seen.recording)),
        Finding.make("clock", lag, why),
        Finding.make("clock rate", rate, why),
    ]


def _speed(recording: Recording) -> float:
    path, knots = np.asarray(recording.handle_path), np.asarray(recording.handle_times)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=-1).max(axis=1)
    return float((moved / np.diff(knots)).max(initial=0.0))


def _lag(seen: Seen) -> tuple[float, float]:
    """How late [s] the top of the cloud follows the grippers, and the rate of its clock, by the
    frames that count; NaN where no axis moves, or the best lag is the longest that is tried."""
    recording = seen.recording
    first, last = recording.info.frames_used
    shown = [f for f in range(first, last + 1) if len(seen.clouds[f]) >= FEWEST]
    tops = {frame: _top(seen.clouds[frame]) for frame in shown}
    lowest = recording.info.table_height + UP if lies(recording) else -np.inf
    up = [frame for frame in shown if tops[frame][2] > lowest]
    if len(up) < FRAMES:
        return np.nan, np.nan
    times, tops = np.asarray(recording.times, np.float64)[up], np.array([tops[f] for f in up])
    path = np.asarray(recording.handle_path)
    compared = (2,) if len(recording.info.sheet.held) == 1 else (2, 0, 1)  # one corner leans aside
    axes = [axis for axis in compared if np.ptp(_leader(path, axis)) > MOVES]
    if not axes:
        return np.nan, np.nan
    start = float(recording.times[0])  # where clocks of any rate agree
    at = [start + rate * (times - start) for rate in RATES]
    left = np.array([[_left(recording, each - lag, tops, axes) for lag in LAGS] for each in at])
    usual = int(np.argmin(np.abs(RATES - 1)))
    best = np.unravel_index(left.argmin(), left.shape)
    if left[best] > CLEARLY * left[usual].min():
        best = (usual, int(left[usual].argmin()))
    written = (usual, int(np.argmin(np.abs(LAGS))))
    if left[written] < NEAR**2 or left[best] > CLEARLY * left[written]:
        best = written
    if best[1] in (0, len(LAGS) - 1):
        return np.nan, np.nan
    return float(LAGS[best[1]]), float(1 / RATES[best[0]])


def _leader(path: Float[np.ndarray, "time gripper 3"], axis: int) -> np.ndarray:
    """What the top of the cloud follows: the highest gripper, or the middle of all."""
    return path[:, :, 2].max(axis=1) if axis == 2 else path[:, :, axis].mean(axis=1)


def _left(recording: Recording, at: np.ndarray, tops: np.ndarray, axes: list[int]) -> float:
    """What is left [m^2] of the tops' motion once that of the grippers at times is subtracted.

    A robust variance, since a top may be of a stray point. A scale that is off by up to `SCALE`
    counts for nothing: in a slow motion it looks like a lag.
    """
    knots = np.asarray(recording.handle_times, np.float64)
    path = np.asarray(recording.handle_path, np.float64)
    left = 0.0
    for axis in axes:
        there = np.interp(at, knots, _leader(path, axis))
        leads, follows = (each - np.median(each) for each in (there, tops[:, axis]))
        size = max(float(leads @ leads), np.finfo(float).tiny)
        off = follows - np.clip(leads @ follows / size, 1 - SCALE, 1 + SCALE) * leads
        left += float((1.4826 * np.median(np.abs(off - np.median(off)))) ** 2)
    return left


def _top(points: Points) -> np.ndarray:
    """The middle of the highest points."""
    high = points[points[:, 2] >= np.quantile(points[:, 2], TOP)]
    return np.median(high, axis=0)
