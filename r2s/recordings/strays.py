"""Points of a recording that are no measurement of the sheet, counted before anything is thinned.

`check` counts them, `evaluate` and `estimate` leave them out (`without_strays`).
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from r2s.recordings.cameras import from_world
from r2s.recordings.recording import (
    CORNERS,
    Recording,
    SheetPlacement,
    clouds_are_markers,
    corner,
    gripper_positions,
)
from r2s.recordings.views import taken_by

Masks = Mapping[str, Bool[np.ndarray, "frame point"]]

REPEATED = 10, 0.01, 5.0  # points at one place: least number, share of a frame, times the usual
BEYOND = 1.15  # of how far the sheet reaches: no point of it is there
FEW, MOST = 0.03, 0.5  # share of points beyond that are kept; above, the pose or unit is wrong
KINDS = {
    "repeats": "are many at one place",
    "behind": "are behind all cameras",
    "far": "are farther from the grippers than the sheet reaches",
}


def strays(recording: Recording) -> Masks:
    """Which points are no measurement of the sheet, by `KINDS`; none where they are markers.

    Many at exactly one place, such as the camera itself; behind every camera that took it; too far
    from a gripper (not of stretchings: knits are pulled to twice their length).
    """
    mask, info = np.asarray(recording.mask), recording.info
    repeats, behind, far = (np.zeros_like(mask) for _ in KINDS)
    farthest = BEYOND * np.array([reach(info.sheet, name) for name in info.sheet.pinned])
    grippers = [] if clouds_are_markers(recording) else gripper_positions(recording)
    for frame, places in enumerate(grippers):
        seen = mask[frame]
        points = np.asarray(recording.points[frame], np.float64)[seen]
        repeats[frame, seen] = at_one_place(points)
        if info.views:
            cameras = [info.views.cameras[i] for i in taken_by(info.views, frame)]
            depths = [from_world(camera, points)[:, 2] for camera in cameras]
            behind[frame, seen] = np.max(depths, axis=0) <= 0
        if info.scenario != "stretching":
            away = np.linalg.norm(points[:, None] - places, axis=-1)
            far[frame, seen] = (away > farthest).any(axis=1)
    behind &= ~repeats
    return {"repeats": repeats, "behind": behind, "far": far & ~repeats & ~behind}


def reach(sheet: SheetPlacement, held: str) -> float:
    """How far the farthest corner is from a corner that is held, [m]."""
    return max(float(np.linalg.norm(corner(sheet, c) - corner(sheet, held))) for c in CORNERS)


def at_one_place(points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, " point"]:
    """Which points are of many at exactly one place; clouds drawn with repetition have none."""
    # one number a point sorts faster than three; others than equal points share it by chance only
    key = points @ np.array([1.0, np.pi, np.e])
    _, place, counts = np.unique(key, return_inverse=True, return_counts=True)
    least, share, usual = REPEATED
    usual *= np.median(counts) if len(counts) > 1 else 1
    return (counts >= max(least, share * len(points), usual))[place]


def share(recording: Recording, kind: str, odd: Masks) -> tuple[float, str]:
    """The share of a recording's points that are of a kind, and words for it."""
    part = float(odd[kind].sum() / max(np.asarray(recording.mask).sum(), 1))
    place = np.median(np.asarray(recording.points, np.float64)[odd[kind]], axis=0) if part else 0
    where = f", about {np.round(place, 3).tolist()} m" if part else ""
    return part, f"{part:.1%} of the points {KINDS[kind]}{where}"


UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 1e3: "metres, not mm"}
OTHER_UNIT = 15.0  # times the sheet's diagonal, or that part of it: no scene is seen so


def check_unit(
    where: Path, points: Float[np.ndarray, "point 3"], size: tuple[float, float]
) -> None:
    """Raise ValueError where points [m] extend over lengths of another order than a sheet's."""
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    extent, diagonal = np.linalg.norm(high - low), np.hypot(*size)
    if extent > 0 and not 1 / OTHER_UNIT < extent / diagonal < OTHER_UNIT:
        factor = min(UNITS, key=lambda unit: abs(np.log(unit * extent / diagonal)))
        raise ValueError(
            f"{where}: its points extend over {extent:.3g} m, the sheet over {diagonal:.3g} m: are "
            f"they in {UNITS[factor]}? Multiply cloud.scale by {factor:g}, or correct sheet.size"
        )


def without_strays(recording: Recording) -> tuple[Recording, str]:
    """A recording without the points that are no measurement of its sheet, and what is said of it.

    Points too far from the grippers are left out where they are more than `FEW`: fewer are outliers
    that an estimate expects. More than `MOST` are said only: then the pose or unit is wrong. Raises
    ValueError that names recording and frame where no point is left.
    """
    odd, mask = strays(recording), np.asarray(recording.mask)
    shares = {kind: share(recording, kind, odd) for kind in KINDS}
    said = [words for kind, (part, words) in shares.items() if part > FEW * (kind == "far")]
    dropped = odd["repeats"] | odd["behind"]
    if FEW < shares["far"][0] <= MOST:
        others = (mask & ~dropped & ~odd["far"]).any(axis=1, keepdims=True)
        dropped = dropped | (odd["far"] & others)
    elif shares["far"][0] > MOST:
        said[-1] += ": pose or unit is wrong, they are kept"
    if not dropped.any():
        return recording, "; ".join(said)
    kept = mask & ~dropped
    for frame in np.flatnonzero(~kept.any(axis=1))[:1]:
        raise ValueError(
            f"recording {recording.info.name}: frame {frame}: no point is left of "
            f"{mask[frame].sum()}: {'; '.join(said)}: export the points that have a depth"
        )
    return replace(recording, mask=jnp.asarray(kept)), f"left out: {'; '.join(said)}"
