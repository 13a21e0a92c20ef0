"""Whether depth cameras agree with each other and with the sheet at rest, while they are known."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s.recordings.cameras import AXIS, DepthCamera, from_world, moved
from r2s.recordings.clouds import voxel_means
from r2s.recordings.recording import SheetPlacement
from r2s.recordings.rgbd import Rig, camera_clouds
from r2s.recordings.views import CameraFit

Points = Float[np.ndarray, "point 3"]

FRAMES = 5  # that are looked at, the first among them
VOXEL = 0.005  # [m], to which each camera's points are thinned
FEWEST = 100  # points of a camera that shows something
AROUND = 0.15  # [m] from its place in which a sheet at rest is looked for
ENDS = 0.005  # quantile at which an extent begins
PIECES = 12  # of a border, in each of which its farthest point is looked for
SIDES = 0.9, 1.1  # times its size: a sheet that is seen whole
PATCH, NEAR = 9, 0.03  # points that make a piece of a surface, within so many metres
COMPARED = 1500  # points of each camera


def fit_cameras(
    folder: Path,
    rig: Rig,
    frame_rate: float,
    sheet: SheetPlacement,
    to_world: Callable[[np.ndarray], np.ndarray],
) -> tuple[CameraFit, ...]:
    """What each camera of an RGB-D recording shows of the sheet at rest, and beside the others.

    At rest is the first frame. `to_world` moves points of the rig [m] into the recording's world.
    """
    frames = camera_clouds(folder, rig, frame_rate, FRAMES)
    thinned = [
        {name: voxel_means(points, VOXEL) for name, points in frame.items() if len(points)}
        for frame in frames
    ]
    switched = [
        {name: _switched(rig.cameras[name], points) for name, points in frame.items()}
        for frame in thinned
    ]
    fits = []
    for name, camera in rig.cameras.items():
        shift = turn = bent = apart = None
        gaps = [_apart(each, name) for each in (thinned, switched)]
        if np.isfinite(gaps).all():
            apart = gaps[0], gaps[1]
        rest = [each[0].get(name, np.zeros((0, 3))) for each in (thinned, switched)]
        if len(rest[0]) >= FEWEST:
            planes = [_plane(to_world(points), sheet) for points in rest]
            if all(planes):
                bent = planes[0][0], planes[1][0]
                if camera.masks and (place := _place(to_world(rest[0]), sheet, planes[0][1])):
                    shift, turn = place
        fits.append(CameraFit(name, camera.depth_along, shift, turn, bent, apart))
    return tuple(fits)


def _switched(camera: DepthCamera, points: Points) -> Points:
    """World points of a camera if the depth in its files was along the other of axis and ray."""
    seen = from_world(camera, points)
    stretched = np.linalg.norm(seen, axis=1) / seen[:, 2]
    factor = 1 / stretched if camera.depth_along == AXIS else stretched
    return moved(np.array(camera.to_world), seen * factor[:, None])


def _axes(sheet: SheetPlacement) -> Float[np.ndarray, "3 3"]:
    """Warp, weft and what stands on both, as rows."""
    return np.array([sheet.warp, sheet.weft, np.cross(sheet.warp, sheet.weft)])


def _plane(points: Points, sheet: SheetPlacement) -> tuple[float, np.ndarray] | None:
    """Distance (root mean square) [m] from a plane, and its normal in the sheet's axes; None where
    the points are not those of a sheet near its place."""
    local = (points - np.array(sheet.origin)) @ _axes(sheet).T
    near = local[np.abs(local[:, 2]) < AROUND]
    if len(near) < 0.9 * len(local):
        return None
    for _ in range(3):  # without stray points
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        off = (near - near.mean(axis=0)) @ normal
        near = near[np.abs(off) <= max(3 * off.std(), 1e-6)]
    return float(off.std()), normal * np.sign(normal[2])


def _place(
    points: Points, sheet: SheetPlacement, normal: np.ndarray
) -> tuple[tuple[float, float, float], float] | None:
    """Shift [m] and turn [degrees] of a flat sheet from its place; None: not seen whole."""
    local = (points - np.array(sheet.origin)) @ _axes(sheet).T
    size, middle, angle = np.array(sheet.size), np.median(local, axis=0), 0.0
    for _ in range(2):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        flat = (local - middle)[:, :2] @ turn.T  # back by the angle
        angle += _slope(flat)
    low, high = np.quantile(flat, [ENDS, 1 - ENDS], axis=0)
    sides = (high - low) / (1 - 2 * ENDS) / size
    if not ((sides > SIDES[0]) & (sides < SIDES[1])).all():
        return None
    tilt = np.arccos(np.clip(normal[2], -1, 1))
    across, along = (middle[:2] + (low + high) / 2 @ turn - size / 2).tolist()
    return (across, along, float(middle[2])), float(np.degrees(np.hypot(tilt, angle)))


def _slope(flat: Float[np.ndarray, "point 2"]) -> float:
    """By which angle [rad] the borders of a rectangle are turned: the median of its four."""
    slopes = []
    for along, sign in ((0, 1), (1, -1)):
        place, out = flat[:, along], flat[:, 1 - along]
        ends = np.linspace(place.min(), place.max(), PIECES + 1)
        pieces = np.digitize(place, ends[1:-1])
        inner = [number for number in range(1, PIECES - 1) if (pieces == number).any()]
        for side in (1, -1):
            border = [side * np.max(side * out[pieces == number]) for number in inner]
            slopes.append(sign * np.polyfit((ends[:-1] + ends[1:])[inner] / 2, border, 1)[0])
    return float(np.arctan(np.median(slopes)))


def _apart(frames: Sequence[dict[str, Points]], name: str) -> float:
    """Median distance [m] of a camera's points across the surface that others see; NaN: none."""
    distances = []
    others = {each for frame in frames for each in frame} - {name}
    for frame, other in itertools.product(frames, sorted(others)):
        if min(len(frame.get(each, ())) for each in (name, other)) < FEWEST:
            continue
        points = frame[name][:: len(frame[name]) // COMPARED + 1]
        gaps, which = KDTree(frame[other]).query(points, PATCH)
        patches = frame[other][which[gaps[:, -1] < NEAR]]
        middles = patches.mean(axis=1, keepdims=True)
        normals = np.linalg.svd(patches - middles, full_matrices=False)[2][:, 2]
        off = points[gaps[:, -1] < NEAR] - middles[:, 0]
        distances += np.abs(np.sum(off * normals, axis=1)).tolist()
    return float(np.median(distances)) if len(distances) >= FEWEST else np.nan
