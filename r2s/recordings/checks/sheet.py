"""Is the sheet as large as was written down, level where it lies, and does it keep its length?"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s.recordings.checks.finding import Finding
from r2s.recordings.checks.seen import FEWEST, Points, Seen, lies
from r2s.recordings.recording import CORNERS, Recording, SheetPlacement, corner

CELL, MOST_SEEN = 0.02, 0.7  # [m] and share of a sheet's cells that must show its extent
NEAR = 0.05  # [m], of the sheet's plane at rest
LONELY = 1.15  # of the next largest: a frame that is alone so far off shows a stray thing
ENDS = 0.005  # quantile at which an extent begins
WHOLE = 0.85  # of how far the sheet reaches, from where on it is seen whole


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
    whole = _seen_share(near, sheet.size) >= MOST_SEEN and len(first) > FEWEST
    why = "" if whole else "no frame shows the whole sheet at rest"
    found = []
    for axis, side in enumerate(("warp", "weft")):
        ends = np.quantile(near[:, axis], [ENDS, 1 - ENDS]) if whole else np.full(2, np.nan)
        ratio = float(np.ptp(ends)) / (1 - 2 * ENDS) / sheet.size[axis]
        found.append(Finding.make("scale", ratio, why, f"scale, {side}"))
    normal = _normal(first) if whole else np.full(3, np.nan)
    tilt = float(np.degrees(np.arccos(np.clip(abs(normal[2]), -1, 1))))
    height = float(np.median(first[:, 2]) - recording.info.table_height) if whole else np.nan
    return [*found, Finding.make("gravity", tilt, why), Finding.make("table", height, why)]


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
    return Finding.make("plumb", tilt, name="gravity")


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
        return [Finding.make("reach", np.nan, f"no frame has {FEWEST} points")]
    most, still = _most(ratios[np.isfinite(ratios)]), ratios[seen.still]
    whole = bool((still > WHOLE).any())
    grown = most / float(np.nanmax(still)) if whole else np.nan
    why = "" if whole else "not seen whole at rest"
    return [Finding.make("reach", most), Finding.make("stretch", grown, why)]


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
    markers, seen = recording.markers, recording.markers_seen
    if markers is None or seen is None:
        return Finding.make("markers", np.nan, "no markers")
    markers, seen = np.asarray(markers), np.asarray(seen)
    places = recording.marker_places
    places = markers[0] if places is None else np.asarray(places)
    gaps, nearest = (np.asarray(each)[:, 1] for each in KDTree(places).query(places, 2))
    apart = np.linalg.norm(markers - markers[:, nearest], axis=-1) / gaps
    both = seen & seen[:, nearest]
    return Finding.make("markers", float(np.quantile(apart[both], 0.95)) if both.any() else np.nan)
