"""What a recording shows of itself: what is suspicious, each with its figure, and its noise."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s.recordings.clouds import connected_pieces, outliers, voxel_means
from r2s.recordings.recording import (
    CORNERS,
    Recording,
    SheetPlacement,
    at_rest,
    cloud,
    clouds_are_markers,
    corner,
    gripper_positions,
)
from r2s.recordings.strays import BEYOND, reach, share, strays, without_strays

Points = Float[np.ndarray, "point 3"]

INF = np.inf
# unit, between which figures it is expected, what the figure is
CHECKS = {
    "frames": ("-", -INF, 5.0, "longest gap between frames over the usual one"),
    "rate": ("Hz", 1.0, 240.0, "frames a second"),
    "grippers": ("m/s", -INF, 5.0, "greatest speed of a gripper"),
    # clean synthetic recordings show up to 0.08 s
    "clock": ("s", -0.1, 0.1, "delay of the top of the cloud after the grippers"),
    "clock rate": ("-", 0.95, 1.05, "how fast the cameras' clock runs"),
    "repeats": ("-", -INF, 0.0, ""),
    "behind": ("-", -INF, 0.0, ""),
    "far": ("-", -INF, 0.03, ""),
    "points": ("-", 150, INF, "points of a frame, thinned to 5 mm,"),
    "outliers": ("-", -INF, 0.03, "share of points that are off the sheet"),
    "grip": ("m", -INF, 0.08, "distance from a gripper to the nearest point (median over frames)"),
    "crop": ("-", -INF, 0.3, ""),
    # a side that was measured with a ruler is good to 0.5 %
    "scale": ("-", 0.975, 1.025, "length of the side at rest, over the one written down,"),
    "gravity": ("degrees", -INF, 1.5, "tilt of the sheet that lies on the table"),
    "plumb": ("degrees", -INF, 4.0, "angle from the vertical of the line from grippers to sheet"),
    "table": ("m", -0.01, 0.01, "height of the sheet at rest above the table"),
    "reach": ("-", 0.55, 1.06, "farthest point from a gripper, over how far the sheet reaches,"),
    "stretch": ("-", -INF, 1.08, "the same, over what it is at rest,"),
    "camera depth": ("-", -INF, 1.5, "bend of a plane, over that with the other depth_along,"),
    "camera apart": ("m", -INF, 0.008, "distance (median) from the surface of the others"),
    "camera shift": ("m", -INF, 0.015, "distance of the sheet at rest from its place"),
    "camera turn": ("degrees", -INF, 1.4, "angle between the sheet at rest and its place"),
    "markers": ("-", 0.5, 1.1, "distance of neighbouring markers over that on the sheet (95 %),"),
}
CALIBRATION = "check the cameras' calibration and depth scale, and the sheet's size"
CLOCK = "check the frame rate and time_offset: does a clap or a jerk come at one time in both?"
POSE = "correct its to_world in cameras.json"
ADVICE = {
    "frames": "many frames in a row were dropped, or times are not their own",
    "rate": "are times in seconds?",
    "grippers": "are the path in metres and its times in seconds?",
    "clock": CLOCK,
    "clock rate": CLOCK,
    "repeats": "nothing was measured there: export the points that have a depth",
    "behind": "is their z forward? Correct the pose, or export points that have a depth",
    "far": "narrow masks or workspace, drop depths at the end of the range, correct pose or unit",
    "points": "move the cameras nearer, or widen masks and workspace",
    "outliers": "clean masks, or narrow the workspace",
    "grip": "the frames of cameras and grippers differ, or the clock does",
    "crop": "widen the workspace or the crop, or move the camera",
    "scale": CALIBRATION,
    "gravity": "the world's z must point up: check the cameras' pose against a level",
    "plumb": "the world's z must point up: check the cameras' pose against a plumb line",
    "table": "check table_height and the cameras' pose",
    "reach": CALIBRATION,
    "stretch": "the sheet stretches, or the cameras' scale changes with the place",
    "camera depth": 'set its "depth_along" in cameras.json to the other of "axis" and "ray"',
    "camera apart": f"{POSE}, and depth_along",
    "camera shift": f"{POSE}; where all say the same, sheet.origin in the manifest",
    "camera turn": f"{POSE}; where all say the same, sheet.warp and sheet.weft",
    "markers": "the sheet stretches, or markers were taken for others",
}

VOXEL = 0.005  # [m], to which clouds are thinned
AROUND, FEW = 0.02, 4  # [m], in which a point of a sheet has more others than that
APART, SCRAP = 0.03, 0.05  # [m] between pieces of a cloud; share of it below which one is no sheet
FEWEST = 50  # points of a frame that shows something
# sheet
CELL, MOST_SEEN = 0.02, 0.7  # [m] and share of a sheet's cells that must show its extent
NEAR_PLANE = 0.05  # [m], of the sheet's plane at rest
LONELY = 1.15  # of the next largest: a single frame so far off shows a stray thing
ENDS = 0.005  # quantile at which an extent begins
WHOLE = 0.85  # of how far the sheet reaches, from where on it is seen whole
# clock
LAGS = np.arange(-50, 51) / 100  # [s], that are tried
RATES = np.array([0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0])  # of the clock, that are tried
CLEARLY = 0.25  # of the residual as written: below, another lag or rate is better
SCALE = 0.1  # of the cameras
TOP = 0.99  # quantile of height from which points are the top
FRAMES = 5  # at least, that show the sheet held up
NEAR = 6e-3  # [m], within which the tops follow the grippers where nothing is wrong
MOVES = 0.05  # [m], at least, along an axis that is compared
UP = 0.1  # [m] above the table: a sheet that is held up
# clouds
NEIGHBOURS, DEVIATIONS = 8, 6.0  # beyond which a point is alone
EDGE = 0.015  # [m], within which a cloud may end at the sheet's border or at a gripper
FACE = 0.003  # [m], thickness of the layer along a face of a box that cut the cloud
CROWDED = 30  # points in that layer, so that a face is one
SAME = 0.0015  # [m], within which the ends of clouds agree where a box cut them
ABOVE = 0.025  # [m] above the table, below which clouds are often cut on purpose
# noise
NOISE_FRAMES, NOISE_POINTS = 6, 300  # that are looked at
PATCH = 16  # points of some mm of a dense cloud, which are nearly in a plane


class Finding(NamedTuple):
    """- `check`: what was looked at. `figure`, `unit`: what was measured; NaN: nothing shows it.
    - `low`, `high`: between which it is expected.
    - `words`: what the figure is; `advice`: what to look at where it is not as expected.
    """

    check: str
    figure: float
    unit: str
    low: float
    high: float
    words: str
    advice: str

    @property
    def is_suspicious(self) -> bool:
        """Whether the figure was measured and is not as expected."""
        return bool(np.isfinite(self.figure)) and not self.low <= self.figure <= self.high

    def describe(self) -> str:
        """One line for people."""
        if not np.isfinite(self.figure):
            return f"not shown   {self.check}: {self.words}"
        unit = "" if self.unit == "-" else f" {self.unit}"
        expected = f"{self.low:g} to {self.high:g}"
        if np.isinf(self.low) or np.isinf(self.high):
            expected = f"at most {self.high:g}" if np.isinf(self.low) else f"at least {self.low:g}"
        line = f"{self.check}: {self.words} {self.figure:.3g}{unit}, expected {expected}{unit}"
        return f"suspicious  {line}: {self.advice}" if self.is_suspicious else f"good        {line}"


def _finding(key: str, figure: float, words: str = "", name: str = "") -> Finding:
    """A figure of one of `CHECKS`; `words`: in place of the usual ones, such as why it is NaN."""
    unit, low, high, usual = CHECKS[key]
    return Finding(name or key, figure, unit, low, high, words or usual, ADVICE[key])


class _Frames(NamedTuple):
    recording: Recording
    thinned: list[Points]  # of each frame, [m]
    clouds: list[Points]  # those that may be of the sheet (`_pieces`)
    grippers: Float[np.ndarray, "frame gripper 3"]  # [m]
    still: list[int]  # frames before the grippers move; the first one at least


def check(recording: Recording) -> list[Finding]:
    """All findings of a recording, the suspicious ones first.

    Points that are no measurement of the sheet are counted before clouds are thinned; the others,
    those that `evaluate` and `estimate` look at, show the rest.
    """
    counts = _check_strays(recording)
    recording = without_strays(recording)[0]
    thinned = [voxel_means(cloud(recording, f), VOXEL) for f in range(len(recording.times))]
    sparse = clouds_are_markers(recording)
    clouds = thinned if sparse else [_pieces(points) for points in thinned]
    still = np.flatnonzero(at_rest(recording)).tolist() or [0]
    frames = _Frames(recording, thinned, clouds, gripper_positions(recording), still)
    findings = [*_check_sheet(frames), *_check_clock(frames)]
    if not sparse:
        findings += [*counts, *_check_clouds(frames), *_check_cameras(recording)]
    return sorted(findings, key=lambda finding: not finding.is_suspicious)


def at_conversion(recording: Recording) -> list[Finding]:
    """What shows of the files alone: points that are no measurement, and each camera."""
    counts = [each for each in _check_strays(recording) if each.check != "far"]
    return [*counts, *_check_cameras(recording)]


def _lies(sheet: SheetPlacement) -> bool:
    """Whether a sheet lies at rest, rather than hangs."""
    return bool(abs(np.cross(sheet.warp, sheet.weft)[2]) > 0.9)


def _pieces(points: Points) -> Float[np.ndarray, "kept 3"]:
    """Points that have others near them, in pieces large enough to be a part of the sheet."""
    if len(points) <= FEW:
        return points
    near = KDTree(points).query_ball_point(points, AROUND, return_length=True)
    points = points[np.asarray(near) > FEW]
    if not len(points):
        return points
    piece = connected_pieces(points, APART)
    return points[(np.bincount(piece) >= SCRAP * len(points))[piece]]


# The sheet: is it as large as was written down, level where it lies, and does it keep its length?


def _check_sheet(frames: _Frames) -> list[Finding]:
    """Scale, gravity and stretch, as far as the recording shows them."""
    recording, first = frames.recording, frames.clouds[frames.still[0]]
    if _lies(recording.info.sheet):
        findings = _lying(recording, first)
    else:  # at rest it hangs below its grippers
        tilt, why = np.nan, "the frame at rest has no two points near each other"
        if len(first):
            away = first.mean(axis=0) - frames.grippers[frames.still[0]].mean(axis=0)
            tilt, why = float(np.degrees(np.arctan2(np.hypot(away[0], away[1]), -away[2]))), ""
        findings = [_finding("plumb", tilt, why, "gravity")]
    return [*findings, *_extents(frames), _marker_distances(recording)]


def _lying(recording: Recording, first: Points) -> list[Finding]:
    """Sides, tilt and height of a sheet that lies on the table."""
    sheet = recording.info.sheet
    axes = np.array([sheet.warp, sheet.weft])
    above = (first - np.array(sheet.origin)) @ np.cross(*axes)
    first = first[np.abs(above) < NEAR_PLANE]
    flat = (first - np.array(sheet.origin)) @ axes.T
    tilt, height, ratios, why = np.nan, np.nan, (np.nan, np.nan), ""
    if _seen_share(flat, sheet.size) >= MOST_SEEN and len(first) > FEWEST:
        ends = np.quantile(flat, [ENDS, 1 - ENDS], axis=0)
        ratios = np.ptp(ends, axis=0) / (1 - 2 * ENDS) / sheet.size
        normal = np.linalg.svd(first - first.mean(axis=0), full_matrices=False)[2][2]
        tilt = float(np.degrees(np.arccos(np.clip(abs(normal[2]), -1, 1))))
        height = float(np.median(first[:, 2]) - recording.info.table_height)
    else:
        why = "no frame shows the whole sheet at rest"
    return [
        _finding("scale", float(ratios[0]), why, "scale, warp"),
        _finding("scale", float(ratios[1]), why, "scale, weft"),
        _finding("gravity", tilt, why),
        _finding("table", height, why),
    ]


def _seen_share(flat: Float[np.ndarray, "point 2"], size: tuple[float, float]) -> float:
    """Share of the cells of a sheet [m] in which points lie."""
    cells = np.maximum(np.array(size) / CELL, 1).astype(int)
    place = np.floor(flat / np.array(size) * cells).astype(int)
    inside = place[((place >= 0) & (place < cells)).all(axis=1)]
    return len(np.unique(inside, axis=0)) / float(cells.prod())


def _extents(frames: _Frames) -> list[Finding]:
    """How far points are from the grippers, over how far the sheet reaches from there."""
    sheet = frames.recording.info.sheet
    farthest = [reach(sheet, name) for name in sheet.pinned]
    ratios = np.full(len(frames.clouds), np.nan)
    for frame, (points, grippers) in enumerate(zip(frames.clouds, frames.grippers, strict=True)):
        if len(points) >= FEWEST:
            away = np.linalg.norm(points[:, None] - grippers[None], axis=-1)
            ratios[frame] = np.max(np.quantile(away, 1 - ENDS, axis=0) / farthest)
    if np.isnan(ratios).all():
        return [_finding("reach", np.nan, f"no frame has {FEWEST} points")]
    largest, *others = sorted(ratios[np.isfinite(ratios)], reverse=True)
    while others and largest > LONELY * others[0]:
        largest, *others = others
    most, still = float(largest), ratios[frames.still]
    if (still > WHOLE).any():
        stretch = _finding("stretch", most / float(np.nanmax(still)))
    else:
        stretch = _finding("stretch", np.nan, "not seen whole at rest")
    return [_finding("reach", most), stretch]


def _marker_distances(recording: Recording) -> Finding:
    """How far apart neighbouring markers get, over how far they are on the sheet."""
    if recording.markers is None or recording.markers_seen is None:
        return _finding("markers", np.nan, "no markers")
    markers, seen = np.asarray(recording.markers), np.asarray(recording.markers_seen)
    places = recording.marker_places
    if places is None:  # they are where the first frame shows them
        places, markers, seen = markers[0, seen[0]], markers[:, seen[0]], seen[:, seen[0]]
    if len(places) < 2:
        return _finding("markers", np.nan, "fewer than two, whose places on the sheet are known")
    places = np.asarray(places)
    gaps, nearest = KDTree(places).query(places, 2)
    gaps, nearest = gaps[:, 1], np.asarray(nearest)[:, 1]
    apart = np.linalg.norm(markers - markers[:, nearest], axis=-1) / gaps
    both = seen & seen[:, nearest]
    if not both.any():
        return _finding("markers", np.nan, "no two neighbours are seen in one frame")
    return _finding("markers", float(np.quantile(apart[both], 0.95)))


# The clock: do the frames come when they should, and when the grippers move?


def _check_clock(frames: _Frames) -> list[Finding]:
    """Intervals, rate, the grippers' speed, and how late the top of the cloud follows them."""
    recording = frames.recording
    gaps = np.diff(np.asarray(recording.times, np.float64))
    middle, longest = np.nan, np.nan
    if len(gaps):
        middle = float(np.median(gaps))
        longest = float(gaps.max() / middle)
    path, knots = np.asarray(recording.gripper_path), np.asarray(recording.gripper_times)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=-1).max(axis=1)
    lag, rate = _lag(frames)
    why = "" if np.isfinite(lag) else "the tops of the clouds do not show it"
    return [
        _finding("frames", longest),
        _finding("rate", 1 / middle),
        _finding("grippers", float((moved / np.diff(knots)).max(initial=0.0))),
        _finding("clock", lag, why),
        _finding("clock rate", rate, why),
    ]


def _lag(frames: _Frames) -> tuple[float, float]:
    """How late [s] the top of the cloud follows the grippers, and the rate of its clock.

    NaN where no axis moves, or the best lag is the longest that is tried.
    """
    recording = frames.recording
    lowest = recording.info.table_height + UP if _lies(recording.info.sheet) else -INF
    tops = {}
    for frame in range(recording.info.frames_used[0], recording.info.frames_used[1] + 1):
        points = frames.clouds[frame]
        if len(points) < FEWEST:
            continue
        highest = points[points[:, 2] >= np.quantile(points[:, 2], TOP)]
        top = np.median(highest, axis=0)
        if top[2] > lowest:
            tops[frame] = top
    compared = (2,) if len(recording.info.sheet.pinned) == 1 else (2, 0, 1)  # one leans aside
    path = np.asarray(recording.gripper_path)
    axes = [axis for axis in compared if np.ptp(_leader(path, axis)) > MOVES]
    if len(tops) < FRAMES or not axes:
        return np.nan, np.nan
    times = np.asarray(recording.times, np.float64)
    start, times = float(times[0]), times[list(tops)]  # clocks of any rate agree at the start
    clocks = [start + rate * (times - start) for rate in RATES]
    places = np.array(list(tops.values()))
    left = np.array([[_residual(recording, t - lag, places, axes) for lag in LAGS] for t in clocks])
    written = (int(np.argmin(np.abs(RATES - 1))), int(np.argmin(np.abs(LAGS))))
    best = np.unravel_index(left.argmin(), left.shape)
    if left[best] > CLEARLY * left[written[0]].min():
        best = (written[0], int(left[written[0]].argmin()))
    if left[written] < NEAR**2 or left[best] > CLEARLY * left[written]:
        best = written
    if best[1] in (0, len(LAGS) - 1):
        return np.nan, np.nan
    return float(LAGS[best[1]]), float(1 / RATES[best[0]])


def _leader(path: Float[np.ndarray, "time gripper 3"], axis: int) -> np.ndarray:
    """What the top of the cloud follows: the highest gripper, or the middle of all."""
    return path[:, :, 2].max(axis=1) if axis == 2 else path[:, :, axis].mean(axis=1)


def _residual(recording: Recording, at: np.ndarray, tops: np.ndarray, axes: list[int]) -> float:
    """Robust variance [m^2] of the tops' motion less that of the grippers at given times.

    Robust, since a top may be a stray point. A scale that is off by up to `SCALE` counts for
    nothing: in a slow motion it looks like a lag.
    """
    knots = np.asarray(recording.gripper_times, np.float64)
    path = np.asarray(recording.gripper_path, np.float64)
    variance = 0.0
    for axis in axes:
        leader = np.interp(at, knots, _leader(path, axis))
        leader = leader - np.median(leader)
        top = tops[:, axis] - np.median(tops[:, axis])
        size = max(float(leader @ leader), np.finfo(float).tiny)
        off = top - np.clip(leader @ top / size, 1 - SCALE, 1 + SCALE) * leader
        variance += float((1.4826 * np.median(np.abs(off - np.median(off)))) ** 2)
    return variance


# The clouds: are there enough points, on the sheet alone, and was none of it cut off?


def _check_strays(recording: Recording) -> list[Finding]:
    """Shares of all points that are no measurement of the sheet, where there are some."""
    odd = strays(recording)
    shares = {kind: share(recording, kind, odd) for kind in odd}
    return [_finding(kind, part, f"{words}:") for kind, (part, words) in shares.items() if part]


def _check_clouds(frames: _Frames) -> list[Finding]:
    """Number of points, outliers, faces of a box that cut the clouds, distance of the grippers."""
    info = frames.recording.info
    used = slice(info.frames_used[0], info.frames_used[1] + 1)
    clouds = frames.thinned[used]
    farthest = BEYOND * np.array([reach(info.sheet, name) for name in info.sheet.pinned])
    stray, near = [], []
    for points, grippers in zip(clouds, frames.grippers[used], strict=True):
        away = np.linalg.norm(points[:, None] - grippers, axis=-1)
        far = (away > farthest).any(axis=1)  # or alone
        stray.append(np.mean(far | outliers(points, NEIGHBOURS, DEVIATIONS)))
        near.append(away.min(axis=0).max())
    findings = [
        _finding("points", float(np.median([len(points) for points in clouds]))),
        _finding("outliers", float(np.median(stray))),
        _finding("grip", float(np.median(near))),
    ]
    edges = np.array([corner(info.sheet, name) for name in CORNERS])
    edges = np.concatenate([edges, frames.grippers[used].reshape(-1, 3)])
    for axis, letter in enumerate("xyz"):
        for side, name in ((-1, "below"), (1, "above")):
            share, place = _cut(clouds, axis, side)
            if axis == 2 and side < 0 and place < info.table_height + ABOVE:
                continue  # the table, or a cut just above it
            if np.abs(edges[:, axis] - place).min() < EDGE:
                share = 0.0  # it is the sheet's own border, at rest or where it is held
            words = f"share of frames whose clouds are cut {name} {letter} = {place:.3f} m"
            findings.append(_finding("crop", share, words, f"crop {letter}"))
    return findings


def _check_cameras(recording: Recording) -> list[Finding]:
    """What each camera alone showed when the recording was converted, as far as it did."""
    findings = []
    for fit in recording.info.camera_fits:
        for kind in ("depth", "apart", "shift", "turn"):
            key = f"camera {kind}"
            if (figure := getattr(fit, kind)) is not None:
                findings.append(_finding(key, figure, name=f"{key} {fit.name}"))
                if kind == "depth" and findings[-1].is_suspicious:
                    break  # the others follow from it
    return findings


def _cut(clouds: list[np.ndarray], axis: int, side: int) -> tuple[float, float]:
    """In which share of the frames clouds end, crowded, at their farthest end, and where [m]."""
    ends = np.array([side * np.max(side * points[:, axis]) for points in clouds])
    place = side * np.max(side * ends)
    crowd = np.array([np.sum(side * (place - points[:, axis]) < FACE + VOXEL) for points in clouds])
    is_cut = (np.abs(ends - place) < SAME + VOXEL / 2) & (crowd >= CROWDED)
    return float(np.mean(is_cut)), float(place)


# Noise of the points


def point_noise(recording: Recording) -> float:
    """Standard deviation [m] of points across the surface; NaN where there are too few.

    It is that from the plane through the `PATCH` nearest points, median over points of some
    frames. The sheet's own curvature within these counts as noise.
    """
    first, last = recording.info.frames_used
    deviations: list[float] = []
    for frame in np.unique(np.linspace(first, last, NOISE_FRAMES).round().astype(int)):
        points = cloud(recording, int(frame))
        if len(points) < PATCH:
            continue
        chosen = points[:: max(1, len(points) // NOISE_POINTS)]
        patches = points[KDTree(points).query(chosen, PATCH)[1]]
        patches = patches - patches.mean(axis=1, keepdims=True)
        least = np.linalg.eigvalsh(np.einsum("pni,pnj->pij", patches, patches))[:, 0]
        # a plane through the patch takes three of its degrees of freedom
        deviations += np.sqrt(np.maximum(least, 0) / (PATCH - 3)).tolist()
    return float(np.median(deviations)) if deviations else math.nan


def mean_distance(deviation: float) -> float:
    """The mean distance [m] from a surface that normal noise of a standard deviation [m] gives."""
    return deviation * math.sqrt(2 / math.pi)
