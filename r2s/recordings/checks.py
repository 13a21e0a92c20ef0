"""What is suspicious in a recording, each with the figure behind it: sheet, clock, clouds."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from r2s.recordings.clouds import outliers, voxel_means
from r2s.recordings.findings import Finding
from r2s.recordings.recording import (
    CORNERS,
    Recording,
    SheetPlacement,
    cloud,
    clouds_are_markers,
    corner,
    gripper_positions,
)

__all__ = ["Finding", "check"]

Points = Float[np.ndarray, "point 3"]

VOXEL = 0.005  # [m], to which clouds are thinned
AROUND, FEW = 0.02, 4  # [m], in which a point of a sheet has more others than that
APART, SCRAP = 0.03, 0.05  # [m] between pieces of a cloud; share of it below which one is no sheet
FEWEST = 50  # points of a frame that shows something
STILL = 0.002  # [m], within which grippers are at rest
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
BEYOND = 1.15  # of how far the sheet reaches: no point of it is there
FACE = 0.003  # [m], thickness of the layer along a face of a box that cut the cloud
CROWDED = 30  # points in that layer, so that a face is one
SAME = 0.0015  # [m], within which the ends of clouds agree where a box cut them
ABOVE = 0.025  # [m] above the table, below which clouds are often cut on purpose


class Frames(NamedTuple):
    """What checks look at.

    - `thinned`: points of each frame, [m]. `clouds`: those that have others around, and are in a
      piece that is large enough to be a part of the sheet.
    - `grippers`: where they are in each frame, [m].
    - `still`: frames before the grippers move; the first one at least.
    """

    recording: Recording
    thinned: list[Points]
    clouds: list[Points]
    grippers: Float[np.ndarray, "frame gripper 3"]
    still: list[int]


def check(recording: Recording) -> list[Finding]:
    """All findings of a recording, the suspicious ones first."""
    thinned = [voxel_means(cloud(recording, f), VOXEL) for f in range(len(recording.times))]
    alone = clouds_are_markers(recording)  # far from each other
    clouds = thinned if alone else [_pieces(points) for points in thinned]
    frames = Frames(recording, thinned, clouds, gripper_positions(recording), _still(recording))
    found = [*_check_sheet(frames), *_check_clock(frames), *_check_clouds(frames)]
    return sorted(found, key=lambda finding: not finding.is_suspicious)


def _lies(recording: Recording) -> bool:
    """Whether the sheet lies at rest, rather than hangs."""
    sheet = recording.info.sheet
    return bool(abs(np.cross(sheet.warp, sheet.weft)[2]) > 0.9)


def _pieces(points: Points) -> Float[np.ndarray, "kept 3"]:
    """Points that have others around them, in pieces large enough to be a part of the sheet."""
    if len(points) <= FEW:
        return points
    around = KDTree(points).query_ball_point(points, AROUND, return_length=True)
    points = points[np.asarray(around) > FEW]
    if not len(points):
        return points
    pairs = KDTree(points).query_pairs(APART, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    piece = connected_components(links, directed=False)[1]
    return points[(np.bincount(piece) >= SCRAP * len(points))[piece]]


def _still(recording: Recording) -> list[int]:
    path, knots = np.asarray(recording.gripper_path), np.asarray(recording.gripper_times)
    moved = np.linalg.norm(path - path[:1], axis=-1).max(axis=1) > STILL
    begins = float(knots[np.argmax(moved)]) if moved.any() else np.inf
    return np.flatnonzero(np.asarray(recording.times) <= begins).tolist() or [0]


# The sheet: is it as large as was written down, level where it lies, and does it keep its length?


def _check_sheet(frames: Frames) -> list[Finding]:
    """Scale, gravity and stretch, as far as the recording shows them."""
    recording, first = frames.recording, frames.clouds[frames.still[0]]
    if _lies(recording):
        found = _lying(recording, first)
    else:  # at rest it hangs below its grippers
        away = first.mean(axis=0) - frames.grippers[0].mean(axis=0)
        tilt = float(np.degrees(np.arctan2(np.hypot(away[0], away[1]), -away[2])))
        found = [Finding.make("plumb", tilt, name="gravity")]
    return [*found, *_extents(frames), _marker_distances(recording)]


def _lying(recording: Recording, first: Points) -> list[Finding]:
    """Sides, tilt and height of a sheet that lies on the table."""
    sheet = recording.info.sheet
    axes = np.array([sheet.warp, sheet.weft])
    above = (first - np.array(sheet.origin)) @ np.cross(*axes)
    first = first[np.abs(above) < NEAR_PLANE]
    flat = (first - np.array(sheet.origin)) @ axes.T
    whole = _seen_share(flat, sheet.size) >= MOST_SEEN and len(first) > FEWEST
    why = "" if whole else "no frame shows the whole sheet at rest"
    found = []
    for axis, side in enumerate(("warp", "weft")):
        ends = np.quantile(flat[:, axis], [ENDS, 1 - ENDS]) if whole else np.full(2, np.nan)
        ratio = float(np.ptp(ends)) / (1 - 2 * ENDS) / sheet.size[axis]
        found.append(Finding.make("scale", ratio, why, f"scale, {side}"))
    tilt, height = np.nan, np.nan
    if whole:
        normal = np.linalg.svd(first - first.mean(axis=0), full_matrices=False)[2][2]
        tilt = float(np.degrees(np.arccos(np.clip(abs(normal[2]), -1, 1))))
        height = float(np.median(first[:, 2]) - recording.info.table_height)
    return [*found, Finding.make("gravity", tilt, why), Finding.make("table", height, why)]


def _seen_share(flat: Float[np.ndarray, "point 2"], size: tuple[float, float]) -> float:
    """Share of the cells of a sheet [m] in which points lie."""
    cells = np.maximum(np.array(size) / CELL, 1).astype(int)
    place = np.floor(flat / np.array(size) * cells).astype(int)
    inside = place[((place >= 0) & (place < cells)).all(axis=1)]
    return len(np.unique(inside, axis=0)) / float(cells.prod())


def _extents(frames: Frames) -> list[Finding]:
    """How far points are from the grippers, over how far the sheet reaches from there."""
    sheet = frames.recording.info.sheet
    ratios = np.full(len(frames.clouds), np.nan)
    for frame, (points, grippers) in enumerate(zip(frames.clouds, frames.grippers, strict=True)):
        if len(points) >= FEWEST:
            away = np.linalg.norm(points[:, None] - grippers[None], axis=-1)
            farthest = np.quantile(away, 1 - ENDS, axis=0)
            ratios[frame] = np.max(farthest / [_reach(sheet, name) for name in sheet.pinned])
    if np.isnan(ratios).all():
        return [Finding.make("reach", np.nan, f"no frame has {FEWEST} points")]
    largest, *others = sorted(ratios[np.isfinite(ratios)], reverse=True)
    while others and largest > LONELY * others[0]:
        largest, *others = others
    most, still = float(largest), ratios[frames.still]
    whole = bool((still > WHOLE).any())
    grown = most / float(np.nanmax(still)) if whole else np.nan
    why = "" if whole else "not seen whole at rest"
    return [Finding.make("reach", most), Finding.make("stretch", grown, why)]


def _reach(sheet: SheetPlacement, held: str) -> float:
    """How far the farthest corner is from a corner that is held, [m]."""
    away = [np.linalg.norm(corner(sheet, name) - corner(sheet, held)) for name in CORNERS]
    return float(max(away))


def _marker_distances(recording: Recording) -> Finding:
    """How far apart neighbouring markers get, over how far they are on the sheet."""
    if recording.markers is None or recording.markers_seen is None:
        return Finding.make("markers", np.nan, "no markers")
    markers, seen = np.asarray(recording.markers), np.asarray(recording.markers_seen)
    places = recording.marker_places
    places = markers[0] if places is None else np.asarray(places)
    gaps, nearest = (np.asarray(found)[:, 1] for found in KDTree(places).query(places, 2))
    apart = np.linalg.norm(markers - markers[:, nearest], axis=-1) / gaps
    both = seen & seen[:, nearest]
    return Finding.make("markers", float(np.quantile(apart[both], 0.95)) if both.any() else np.nan)


# The clock: do the frames come when they should, and when the grippers move?


def _check_clock(frames: Frames) -> list[Finding]:
    """Intervals, rate, the grippers' speed, and how late the top of the cloud follows them."""
    recording = frames.recording
    gaps = np.diff(np.asarray(recording.times, np.float64))
    middle = float(np.median(gaps)) if len(gaps) else np.nan
    uneven = float(np.abs(gaps / middle - 1).max()) if len(gaps) else np.nan
    path, knots = np.asarray(recording.gripper_path), np.asarray(recording.gripper_times)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=-1).max(axis=1)
    lag, rate = _lag(frames)
    why = "" if np.isfinite(lag) else "the tops of the clouds do not show it"
    return [
        Finding.make("frames", uneven),
        Finding.make("rate", 1 / middle),
        Finding.make("grippers", float((moved / np.diff(knots)).max(initial=0.0))),
        Finding.make("clock", lag, why),
        Finding.make("clock rate", rate, why),
    ]


def _lag(frames: Frames) -> tuple[float, float]:
    """How late [s] the top of the cloud follows the grippers, and the rate of its clock.

    NaN where no axis moves, or the best lag is the longest that is tried.
    """
    recording = frames.recording
    first, last = recording.info.frames_used
    shown = [f for f in range(first, last + 1) if len(frames.clouds[f]) >= FEWEST]
    tops = {frame: _top(frames.clouds[frame]) for frame in shown}
    lowest = recording.info.table_height + UP if _lies(recording) else -np.inf
    up = [frame for frame in shown if tops[frame][2] > lowest]
    path = np.asarray(recording.gripper_path)
    compared = (2,) if len(recording.info.sheet.pinned) == 1 else (2, 0, 1)  # one leans aside
    axes = [axis for axis in compared if np.ptp(_leader(path, axis)) > MOVES]
    if len(up) < FRAMES or not axes:
        return np.nan, np.nan
    times, tops = np.asarray(recording.times, np.float64)[up], np.array([tops[f] for f in up])
    start = float(recording.times[0])  # where clocks of any rate agree
    clocks = [start + rate * (times - start) for rate in RATES]
    left = np.array([[_residual(recording, t - lag, tops, axes) for lag in LAGS] for t in clocks])
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


def _residual(recording: Recording, at: np.ndarray, tops: np.ndarray, axes: list[int]) -> float:
    """Robust variance [m^2] of the tops' motion less that of the grippers at given times.

    Robust, since a top may be a stray point. A scale that is off by up to `SCALE` counts for
    nothing: in a slow motion it looks like a lag.
    """
    knots = np.asarray(recording.gripper_times, np.float64)
    path = np.asarray(recording.gripper_path, np.float64)
    left = 0.0
    for axis in axes:
        there = np.interp(at, knots, _leader(path, axis))
        leads, follows = (places - np.median(places) for places in (there, tops[:, axis]))
        size = max(float(leads @ leads), np.finfo(float).tiny)
        off = follows - np.clip(leads @ follows / size, 1 - SCALE, 1 + SCALE) * leads
        left += float((1.4826 * np.median(np.abs(off - np.median(off)))) ** 2)
    return left


def _top(points: Points) -> np.ndarray:
    """The middle of the highest points."""
    return np.median(points[points[:, 2] >= np.quantile(points[:, 2], TOP)], axis=0)


# The clouds: are there enough points, on the sheet alone, and was none of it cut off?


def _check_clouds(frames: Frames) -> list[Finding]:
    """Number of points, outliers, faces of a box that cut the clouds, distance of the grippers."""
    recording = frames.recording
    if clouds_are_markers(recording):
        return []
    first, last = recording.info.frames_used
    clouds, held = frames.thinned[first : last + 1], frames.grippers[first : last + 1]
    pairs = list(zip(clouds, held, strict=True))
    near = [np.max(KDTree(points).query(at)[0]) for points, at in pairs]
    stray = [_stray_share(recording.info.sheet, *pair) for pair in pairs]
    found = [
        Finding.make("points", float(np.median([len(points) for points in clouds]))),
        Finding.make("outliers", float(np.median(stray))),
        Finding.make("grip", float(np.median(near))),
    ]
    for axis, letter in enumerate("xyz"):
        for side, name in ((-1, "below"), (1, "above")):
            share, place = _cut(clouds, axis, side)
            if axis == 2 and side < 0 and place < recording.info.table_height + ABOVE:
                continue  # the table, or a cut just above it
            words = f"share of frames whose clouds are cut {name} {letter} = {place:.3f} m"
            found.append(Finding.make("crop", share, words, f"crop {letter}"))
    return found


def _stray_share(
    sheet: SheetPlacement,
    points: Float[np.ndarray, "point 3"],
    held: Float[np.ndarray, "gripper 3"],
) -> float:
    """Share of points that are alone, or farther from a gripper than the sheet reaches."""
    far = np.zeros(len(points), bool)
    for name, at in zip(sheet.pinned, held, strict=True):
        far |= np.linalg.norm(points - at, axis=1) > BEYOND * _reach(sheet, name)
    return float(np.mean(far | outliers(points, NEIGHBOURS, DEVIATIONS)))


def _cut(clouds: list[np.ndarray], axis: int, side: int) -> tuple[float, float]:
    """In which share of the frames clouds end, crowded, at their farthest end, and where [m]."""
    ends = np.array([side * np.max(side * points[:, axis]) for points in clouds])
    place = side * np.max(side * ends)
    crowd = np.array([np.sum(side * (place - points[:, axis]) < FACE + VOXEL) for points in clouds])
    there = (np.abs(ends - place) < SAME + VOXEL / 2) & (crowd >= CROWDED)
    return float(np.mean(there)), float(place)
