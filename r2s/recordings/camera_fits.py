"""Whether depth cameras agree with each other and with the sheet at rest, while they are known."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, KDTree

from r2s.recordings.cameras import DepthCamera, from_world, moved
from r2s.recordings.recording import SheetPlacement
from r2s.recordings.views import CameraFit

Points = Float[np.ndarray, "_ 3"]

FRAMES, FEWEST = 5, 100  # frames that are looked at; points that show something
AROUND = 0.15  # [m] from its place in which a sheet at rest is looked for
BORDER = 0.012  # [m] from the border of a sheet that is seen
PATCH, BESIDE = 9, 0.015  # points that make a piece of a surface; [m] from it along the surface
COMPARED = 1500  # points of each camera
LEAST = 2e-3  # [m], of a distance that another is divided by: noise and wrinkles


def fit_cameras(
    cameras: Mapping[str, DepthCamera],
    alone: Sequence[Mapping[str, Points]],
    sheet: SheetPlacement,
    to_world: Callable[[Points], Points] = lambda points: points,
    still: Sequence[bool] | None = None,
) -> tuple[CameraFit, ...]:
    """What each camera of an RGB-D recording shows of the sheet at rest, and beside the others.

    `alone`: each frame's points [m] by the cameras that took it, in the cameras' world
    (`read_clouds`), which `to_world` moves into the recording's. `still`: in which frames the sheet
    is at rest (None: in all); a camera is compared with its place in the first that it took.
    """
    seen = [{n: part for n, part in each.items() if len(part) >= FEWEST} for each in alone]
    axes = np.array([sheet.warp, sheet.weft, np.cross(sheet.warp, sheet.weft)])
    fits = []
    for name, camera in cameras.items():
        own = [frame for frame, each in enumerate(alone) if name in each]
        chosen = np.unique(np.linspace(0, len(own) - 1, min(FRAMES, len(own))).round().astype(int))
        read = [seen[own[i]] for i in chosen]
        # as if the depth in the files was along the other of axis and ray
        other = [{n: _switched(cameras[n], part) for n, part in each.items()} for each in read]
        off = [_apart(frames, name) for frames in (read, other)]
        fit = {"apart": off[0]}
        if read and name in read[0] and (still is None or still[own[0]]):
            rest, bowl = ((to_world(f[0][name]) - sheet.origin) @ axes.T for f in (read, other))
            if np.mean(np.abs(rest[:, 2]) < AROUND) > 0.9:
                if abs(axes[2, 2]) > 0.9:  # what hangs is bent by its weight
                    off = [_plane(points)[0] for points in (rest, bowl)]
                if camera.masks:
                    fit["shift"], fit["turn"] = _place(rest, np.array(sheet.size))
        fit["depth"] = off[0] / max(off[1], LEAST)
        fit = {kind: figure for kind, figure in fit.items() if np.isfinite(figure)}
        fits.append(CameraFit(name, **fit))
    return tuple(fits)


def _switched(camera: DepthCamera, points: Points) -> Points:
    seen = from_world(camera, points)
    stretched = np.linalg.norm(seen, axis=1, keepdims=True) / seen[:, 2:]
    seen = seen / stretched if camera.depth_along == "axis" else seen * stretched
    return moved(np.array(camera.to_world), seen)


def _plane(points: Points) -> tuple[float, Float[np.ndarray, "3"]]:
    """Distance (root mean square) [m] of points, but for stray ones, from a plane; its normal."""
    off, normal = np.zeros(len(points)), np.zeros(3)
    for _ in range(3):
        points = points[np.abs(off) <= 3 * off.std()]
        points = points - points.mean(axis=0)
        normal = np.linalg.svd(points, full_matrices=False)[2][2]
        off = points @ normal
    return float(off.std()), normal


def _place(rest: Points, size: Float[np.ndarray, "2"]) -> tuple[float, float]:
    """Shift [m] and turn [degrees] of a flat sheet from its place: those with which the hull of its
    points is the sheet's border, but for parts; NaN where that is not most of the hull."""
    flat, middle = rest[:, :2], np.median(rest, axis=0)
    hull = flat[ConvexHull(flat, qhull_options="QJ").vertices]

    def beyond(move: np.ndarray) -> np.ndarray:
        back = np.array([[np.cos(move[2]), -np.sin(move[2])], [np.sin(move[2]), np.cos(move[2])]])
        return (np.abs((hull - size / 2 - move[:2]) @ back) - size / 2).max(axis=1)

    start = [*(middle[:2] - size / 2), 0.0]
    move = least_squares(beyond, start, loss="soft_l1", f_scale=BORDER / 4, x_scale=0.01).x
    if np.mean(np.abs(beyond(move)) < BORDER) < 0.5:
        return np.nan, np.nan
    tilt = np.arccos(min(abs(_plane(rest)[1][2]), 1))
    return float(np.linalg.norm([*move[:2], middle[2]])), float(np.degrees(np.hypot(tilt, move[2])))


def _apart(frames: Sequence[Mapping[str, Points]], name: str) -> float:
    """Median distance [m] of a camera's points across the surface that others see; NaN: none."""
    distances = [np.zeros(0)]
    for frame in (each for each in frames if name in each):
        points = frame[name][:: len(frame[name]) // COMPARED + 1]
        for surface in (frame[other] for other in frame if other != name):
            gaps, which = KDTree(surface).query(points, PATCH)
            middles = surface[which].mean(axis=1, keepdims=True)
            normals = np.linalg.svd(surface[which] - middles, full_matrices=False)[2][:, 2]
            off = points - middles[:, 0]
            across = np.abs(np.sum(off * normals, axis=1))
            beside = np.linalg.norm(off, axis=1) ** 2 - across**2
            distances.append(across[(beside < BESIDE**2) & (gaps[:, -1] < AROUND)])
    every = np.concatenate(distances)
    return float(np.median(every)) if len(every) >= FEWEST else np.nan
