"""Is the sheet as large as was written down, level where it lies, and does it keep its length?"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s.recordings.checks.finding import Finding
from r2s.recordings.readers.clouds import voxel_means
from r2s.recordings.recording import CORNERS, Recording, cloud, corner

Points = Float[np.ndarray, "point 3"]

VOXEL = 0.005  # [m], to which clouds are thinned
AROUND, FEW = 0.02, 4  # [m], in which a point of a sheet has more others than that
FEWEST = 50  # points, of a frame that shows something
STILL = 0.002  # [m], within which grippers are at rest
CELL, MOST_SEEN = 0.02, 0.7  # [m] and share of a sheet's cells that must show its extent
NEAR = 0.05  # [m], of the sheet's plane at rest
ENDS = 0.005  # quantile at which an extent begins
SCALE = 0.025  # relative, of a length; a side that was measured with a ruler is good to 0.5 %
LEVEL, PLUMB = 1.5, 4.0  # [degrees]
HEIGHT = 0.01  # [m]
REACH, GROWTH = 1.06, 1.08  # of the sheet's own length
STRAIN = 1.1  # of the distances between neighbouring markers

CALIBRATION = "check the cameras' calibration and depth scale, and the sheet's size"


def cleaned(recording: Recording, frame: int) -> Points:
    """A frame's points [m], thinned, but for those that have few others around."""
    points = voxel_means(cloud(recording, frame), VOXEL)
    if recording.markers is not None or len(points) <= FEW:
        return points
    around = KDTree(points).query_ball_point(points, AROUND, return_length=True)
    return points[np.asarray(around) > FEW]


def at_rest(recording: Recording) -> list[int]:
    """Frames before the grippers move; the first one at least."""
    path, knots = np.asarray(recording.handle_path), np.asarray(recording.handle_times)
    moved = np.linalg.norm(path - path[:1], axis=-1).max(axis=1) > STILL
    begins = float(knots[np.argmax(moved)]) if moved.any() else np.inf
    still = np.flatnonzero(np.asarray(recording.times) <= begins)
    return still.tolist() or [0]


def lies(recording: Recording) -> bool:
    """Whether the sheet lies at rest, rather than hangs."""
    sheet = recording.info.sheet
    return bool(abs(np.cross(sheet.warp, sheet.weft)[2]) > 0.9)


def check_sheet(recording: Recording) -> list[Finding]:
    """Scale, gravity and stretch, as far as the recording shows them."""
    first = cleaned(recording, at_rest(recording)[0])
    found = [*_lying(recording, first)] if lies(recording) else [_plumb(recording, first)]
    found += _reach(recording)
    return [*found, _markers_apart(recording)]


def _lying(recording: Recording, first: Points) -> list[Finding]:
    sheet = recording.info.sheet
    axes = np.array([sheet.warp, sheet.weft])
    flat = (first - np.array(sheet.origin)) @ axes.T
    above = (first - np.array(sheet.origin)) @ np.cross(*axes)
    near = flat[np.abs(above) < NEAR]
    whole = _seen_share(near, sheet.size) >= MOST_SEEN
    found = []
    for axis, side in enumerate(("warp", "weft")):
        ends = np.quantile(near[:, axis], [ENDS, 1 - ENDS]) if whole else np.full(2, np.nan)
        ratio = float(np.ptp(ends)) / (1 - 2 * ENDS) / sheet.size[axis]
        words = f"length along the {side} at rest, over the one written down,"
        words = words if whole else "no frame shows the whole sheet at rest"
        found.append(
            Finding(f"scale, {side}", ratio, "-", 1 - SCALE, 1 + SCALE, words, CALIBRATION)
        )
    spread = first - first.mean(axis=0)
    is_flat = len(first) > 50 and whole
    normal = np.linalg.svd(spread, full_matrices=False)[2][2] if is_flat else np.full(3, np.nan)
    tilt = float(np.degrees(np.arccos(np.clip(abs(normal[2]), -1, 1))))
    words = "tilt of the sheet that lies on the table" if is_flat else words
    advice = "the world's z must point up: check the cameras' pose against a level"
    found.append(Finding("gravity", tilt, "degrees", -np.inf, LEVEL, words, advice))
    height = float(np.median(first[:, 2]) - recording.info.table_height) if is_flat else np.nan
    words = "height of the sheet at rest above the table" if is_flat else words
    advice = "check table_height and the cameras' pose"
    return [*found, Finding("table", height, "m", -HEIGHT, HEIGHT, words, advice)]


def _seen_share(flat: Float[np.ndarray, "point 2"], size: tuple[float, float]) -> float:
    """Share of the cells of a sheet [m] in which points lie."""
    cells = np.maximum(np.array(size) / CELL, 1).astype(int)
    place = np.floor(flat / np.array(size) * cells).astype(int)
    inside = place[((place >= 0) & (place < cells)).all(axis=1)]
    return len(np.unique(inside, axis=0)) / float(cells.prod())


def _plumb(recording: Recording, first: Points) -> Finding:
    """How far a sheet that hangs at rest is from below its grippers."""
    held = np.asarray(recording.handle_path[0]).mean(axis=0)
    away = first.mean(axis=0) - held
    tilt = float(np.degrees(np.arctan2(np.hypot(away[0], away[1]), -away[2])))
    words = "angle from the vertical of the line from the grippers to the middle of the sheet"
    advice = "the world's z must point up: check the cameras' pose against a plumb line"
    return Finding("gravity", tilt, "degrees", -np.inf, PLUMB, words, advice)


def _reach(recording: Recording) -> list[Finding]:
    """How far points are from the grippers, over how far the sheet reaches from there."""
    path, knots = np.asarray(recording.handle_path), np.asarray(recording.handle_times)
    times = np.asarray(recording.times)
    sheet, names = recording.info.sheet, recording.info.sheet.held
    far = [max(np.linalg.norm(corner(sheet, n) - corner(sheet, h)) for n in CORNERS) for h in names]
    ratios = []
    for frame, time in enumerate(times):
        points = cleaned(recording, frame)
        if len(points) < FEWEST:
            continue
        for handle, farthest in enumerate(far):
            held = [np.interp(time, knots, path[:, handle, k]) for k in range(3)]
            reach = np.quantile(np.linalg.norm(points - held, axis=1), 1 - ENDS)
            ratios.append((frame, reach / farthest))
    if not ratios:
        nothing = f"no frame has {FEWEST} points"
        return [Finding("reach", np.nan, "-", 0.6, REACH, nothing, CALIBRATION)]
    numbers = np.array([ratio for _, ratio in ratios])
    still = np.array([frame in set(at_rest(recording)) for frame, _ in ratios])
    words = "farthest point from a gripper, over how far the sheet reaches from there,"
    found = [Finding("reach", float(numbers.max()), "-", 0.6, REACH, words, CALIBRATION)]
    grown = float(numbers.max() / numbers[still].max()) if still.any() else np.nan
    words = "the same, over what it is at rest,"
    advice = "the sheet stretches, or the cameras' scale changes with the place"
    whole = still.any() and numbers[still].max() > 0.85
    words = words if whole else "the sheet is not seen whole at rest"
    grown = grown if whole else np.nan
    return [*found, Finding("stretch", grown, "-", -np.inf, GROWTH, words, advice)]


def _markers_apart(recording: Recording) -> Finding:
    """How far apart neighbouring markers get, over how far they are on the sheet."""
    words, advice = "no markers", "the sheet stretches, or markers were taken for others"
    ratio = np.nan
    if recording.markers is not None and recording.markers_seen is not None:
        markers, seen = np.asarray(recording.markers), np.asarray(recording.markers_seen)
        places = recording.marker_places
        places = markers[0] if places is None else np.asarray(places)
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
        gaps[np.diag_indices(len(gaps))] = np.inf
        next_to = gaps.argmin(axis=1)
        apart = np.linalg.norm(markers - markers[:, next_to], axis=-1) / gaps.min(axis=1)
        both = seen & seen[:, next_to]
        ratio = float(np.quantile(apart[both], 0.95)) if both.any() else np.nan
        words = "distance of neighbouring markers over that on the sheet (95 %),"
    return Finding("markers", ratio, "-", 0.5, STRAIN, words, advice)
