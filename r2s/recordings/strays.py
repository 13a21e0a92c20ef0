"""Points of a recording that are no measurement of the sheet, counted before anything is thinned.

`check` counts them, `evaluate` and `estimate` leave them out (`without_strays`).
"""

from dataclasses import replace
from typing import NamedTuple

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

MANY, MORE = 10, 0.01  # points, and share of a frame's, at one place that is no point of a sheet
COPIES = 5.0  # times as many as of other points: clouds that were drawn with repetition have some
BEYOND = 1.15  # of how far the sheet reaches: no point of it is there
FEW, MOST = 0.03, 0.5  # share of points beyond that is left alone; above, the pose or unit is wrong


class Strays(NamedTuple):
    """Which points of a recording are no measurement of the sheet.

    - `repeated`: many at exactly one place, such as the camera itself.
    - `behind`: behind every camera of `views`. `far`: farther from a gripper than a sheet reaches.
    """

    repeated: Bool[np.ndarray, "frame point"]
    behind: Bool[np.ndarray, "frame point"]
    far: Bool[np.ndarray, "frame point"]


def strays(recording: Recording) -> Strays:
    """Which points are no measurement of the sheet; none where the points are markers."""
    mask, info = np.asarray(recording.mask), recording.info
    repeated, behind, far = (np.zeros_like(mask) for _ in range(3))
    if clouds_are_markers(recording):
        return Strays(repeated, behind, far)
    farthest = BEYOND * np.array([reach(info.sheet, name) for name in info.sheet.pinned])
    cameras = info.views.cameras if info.views else ()
    for frame, grippers in enumerate(gripper_positions(recording)):
        seen = mask[frame]
        points = np.asarray(recording.points[frame], np.float64)[seen]
        repeated[frame, seen] = at_one_place(points)
        if cameras:
            depths = [from_world(camera, points)[:, 2] for camera in cameras]
            behind[frame, seen] = np.max(depths, axis=0) <= 0
        if info.scenario != "stretching":  # knits are pulled to twice their length
            away = np.linalg.norm(points[:, None] - grippers, axis=-1)
            far[frame, seen] = (away > farthest).any(axis=1)
    return Strays(repeated, behind & ~repeated, far & ~repeated & ~behind)


def reach(sheet: SheetPlacement, held: str) -> float:
    """How far the farthest corner is from a corner that is held, [m]."""
    return max(float(np.linalg.norm(corner(sheet, c) - corner(sheet, held))) for c in CORNERS)


def at_one_place(points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, " point"]:
    """Which points are those of many at exactly one place, where a camera measured nothing."""
    # one number a point sorts faster than three; others than equal points share it by chance only
    _, place, counts = np.unique(
        points @ np.array([1.0, np.pi, np.e]), return_inverse=True, return_counts=True
    )
    usual = np.median(counts) if len(counts) > 1 else 1
    return (counts >= max(MANY, MORE * len(points), COPIES * usual))[place]


def share(recording: Recording, which: Bool[np.ndarray, "frame point"]) -> tuple[float, list]:
    """The share of a recording's points, and their median place [m]."""
    chosen = np.asarray(recording.points, np.float64)[which]
    place = np.median(chosen, axis=0).round(3).tolist() if len(chosen) else []
    return float(which.sum() / max(np.asarray(recording.mask).sum(), 1)), place


def words(recording: Recording, odd: Strays) -> list[str]:
    """What is said of the points at one place, and behind the cameras."""
    said = []
    for which, what in (
        (odd.repeated, "are many at one place"),
        (odd.behind, "are behind all cameras"),
    ):
        part, place = share(recording, which)
        if part:
            said.append(f"{part:.1%} of the points {what}, {place} m, no points of a sheet")
    return said


def without_strays(recording: Recording) -> tuple[Recording, str]:
    """A recording without the points that are no measurement of its sheet, and what is said of it.

    Points that are too far from the grippers are left out where they are more than `FEW`: fewer are
    the outliers that an estimate expects. More than `MOST` are said only: then pose or unit is
    wrong. Raises ValueError that names the recording and the frame where no point is left.
    """
    odd = strays(recording)
    said, left_out = words(recording, odd), odd.repeated | odd.behind
    part, place = share(recording, odd.far)
    if part > FEW:
        far = f"{part:.1%} are farther from the grippers than the sheet reaches, about {place} m"
        said.append(far if part <= MOST else f"{far}: pose or unit is wrong, they are kept")
        left_out = left_out | odd.far if part <= MOST else left_out
    if not left_out.any():
        return recording, "; ".join(said)
    kept = np.asarray(recording.mask) & ~left_out
    for frame in np.flatnonzero(~kept.any(axis=1))[:1]:
        raise ValueError(
            f"recording {recording.info.name}: frame {frame}: no point is left of "
            f"{np.asarray(recording.mask)[frame].sum()}: {'; '.join(said)}: export the points "
            "that have a depth"
        )
    order = np.argsort(~kept, axis=1, kind="stable")  # the padding comes last
    points = np.take_along_axis(np.where(kept[..., None], recording.points, 0), order[..., None], 1)
    width = int(kept.sum(axis=1).max())
    mask = np.take_along_axis(kept, order, axis=1)[:, :width]
    thinner = replace(recording, points=jnp.asarray(points[:, :width]), mask=jnp.asarray(mask))
    return thinner, f"left out: {'; '.join(said)}"
