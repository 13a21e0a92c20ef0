"""Is the sheet as large as was written down, level where it lies, and does it keep its length?"""

import numpy as np
from jaxtyping import Float

from r2s.recordings.checks.finding import Finding
from r2s.recordings.checks.seen import FEWEST, Points, Seen, lies
from r2s.recordings.recording import CORNERS, Recording, SheetPlacement, corner

CELL, MOST_SEEN = 0.02, 0.7  # [m] and share of a sheet's cells that must show its extent
NEAR = 0.05  # [m], of the sheet's plane at rest
LONELY = 1.15  # of the next largest: a frame that is alone so far off shows a stray thing
ENDS = 0.005  # quantile at which an extent begins
SCALE = 0.025  # relative, of a length; a side that was measured with a ruler is good to 0.5 %
LEVEL, PLUMB = 1.5, 4.0  # [degrees]
HEIGHT = 0.01  # [m]
LEAST_REACH, REACH, GROWTH = 0.55, 1.06, 1.08  # of the sheet's own length
WHOLE = 0.85  # of that, from where on a sheet is seen whole
STRAIN = 1.1  # of the distances between neighbouring markers

CALIBRATION = "check the cameras' calibration and depth scale, and the sheet's size"


def check_sheet(seen: Seen) -> list[Finding]:
    """Scale, gravity and stretch, as far as the recording shows them."""
    recording, first = seen.recording, seen.clouds[seen.still[0]]
    found = _lying(recording, first) if lies(recording) else [_plumb(seen.grippers[0], first)]
    return [*found, *_reach(seen), _markers_apart(recording)]


def _lying(recording: Recording, first: Points) -> list[Finding]:
    sheet = recording.info.sheet
    axes = np.array([sheet.warp, sheet.weft])
    flat = (first - np.array(sheet.origin)) @ axes.T
    above = (first - np.array(sheet.origin)) @ np.cross(*axes)
    first = first[np.abs(above) < NEAR]
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
    is_flat = len(first) > 50 and whole
    normal = _normal(first) if is_flat else np.full(3, np.nan)
    tilt = float(np.degrees(np.arccos(np.clip(abs(normal[2]), -1, 1))))
    words = "tilt of the sheet that lies on the table" if is_flat else words
    advice = "the world's z must point up: check the cameras' pose against a level"
    found.append(Finding("gravity", tilt, "degrees", -np.inf, LEVEL, words, advice))
    height = float(np.median(first[:, 2]) - recording.info.table_height) if is_flat else np.nan
    words = "height of the sheet at rest above the table" if is_flat else words
    advice = "check table_height and the cameras' pose"
    return [*found, Finding("table", height, "m", -HEIGHT, HEIGHT, words, advice)]


def _normal(points: Points) -> Float[np.ndarray, " 3"]:
    """Normal of the plane that lies nearest to some points."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]


def _seen_share(flat: Float[np.ndarray, "point 2"], size: tuple[float, float]) -> float:
    """Share of the cells of a sheet [m] in which points lie."""
    cells = np.maximum(np.array(size) / CELL, 1).astype(int)
    place = np.floor(flat / np.array(size) * cells).astype(int)
    inside = place[((place >= 0) & (place < cells)).all(axis=1)]
    return len(np.unique(inside, axis=0)) / float(cells.prod())


def _plumb(grippers: Float[np.ndarray, "gripper 3"], first: Points) -> Finding:
    """How far a sheet that hangs at rest is from below its grippers."""
    away = first.mean(axis=0) - grippers.mean(axis=0)
    tilt = float(np.degrees(np.arctan2(np.hypot(away[0], away[1]), -away[2])))
    words = "angle from the vertical of the line from the grippers to the middle of the sheet"
    advice = "the world's z must point up: check the cameras' pose against a plumb line"
    return Finding("gravity", tilt, "degrees", -np.inf, PLUMB, words, advice)


def _reach(seen: Seen) -> list[Finding]:
    """How far points are from the grippers, over how far the sheet reaches from there."""
    sheet = seen.recording.info.sheet
    ratios = np.full(len(seen.clouds), np.nan)
    for frame, (points, grippers) in enumerate(zip(seen.clouds, seen.grippers, strict=True)):
        if len(points) >= FEWEST:
            away = np.linalg.norm(points[:, None] - grippers[None], axis=-1)
            farthest = np.quantile(away, 1 - ENDS, axis=0)
            ratios[frame] = np.max(farthest / [reach(sheet, name) for name in sheet.held])
    if np.isnan(ratios).all():
        nothing = f"no frame has {FEWEST} points"
        return [Finding("reach", np.nan, "-", LEAST_REACH, REACH, nothing, CALIBRATION)]
    most, still = _most(ratios[np.isfinite(ratios)]), ratios[seen.still]
    words = "farthest point from a gripper, over how far the sheet reaches from there,"
    found = [Finding("reach", most, "-", LEAST_REACH, REACH, words, CALIBRATION)]
    whole = bool((still > WHOLE).any())
    words = "the same, over what it is at rest," if whole else "not seen whole at rest"
    grown = most / float(np.nanmax(still)) if whole else np.nan
    advice = "the sheet stretches, or the cameras' scale changes with the place"
    return [*found, Finding("stretch", grown, "-", -np.inf, GROWTH, words, advice)]


def _most(ratios: Float[np.ndarray, " frame"]) -> float:
    """The largest that does not stand alone."""
    largest, *others = sorted(ratios, reverse=True)
    while others and largest > LONELY * others[0]:
        largest, *others = others
    return float(largest)


def reach(sheet: SheetPlacement, held: str) -> float:
    """How far the farthest corner is from a corner that is held, [m]."""
    away = [np.linalg.norm(corner(sheet, name) - corner(sheet, held)) for name in CORNERS]
    return float(max(away))


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
