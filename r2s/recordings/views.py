"""What calibrated cameras see of a mesh."""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.recordings.cameras import DepthCamera, back_project, from_world, moved, rays, rows_of
from r2s.recordings.clouds import Cleaning, Corner, clean

NEAREST = 0.01  # [m]: what is nearer than this, or behind the camera, is not seen
ROUNDING = 1e-9


def render(
    camera: DepthCamera, x: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> tuple[Float[np.ndarray, "down across"], Int[np.ndarray, "down across"]]:
    """Depth [m] of what each pixel's middle sees of a mesh [m], and which face; 0 and -1 if none.

    A z-buffer, exact: depths are those at which the pixels' rays, bent by the lens, meet the
    triangles. Both sides of a face are seen.
    """
    directions = rays(camera)
    corners = from_world(camera, np.asarray(x, np.float64))[faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    # A ray d meets the plane of a, b, c with the barycentric weights d.(b x c), d.(c x a),
    # d.(a x b), but for a factor, and at the depth det(a, b, c) / (sum of them).
    sides = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    volume = np.einsum("fi,fi->f", a, sides[..., 0])
    sides, volume = sides * np.sign(volume)[:, None, None], np.abs(volume)
    boxes = _boxes(directions, corners)
    depth = np.full(directions.shape[:2], np.inf)
    which = np.full(directions.shape[:2], -1, np.int32)
    for face in np.flatnonzero(corners[..., 2].max(axis=1) > NEAREST):
        left, right, top, bottom = boxes[face]
        patch = slice(top, bottom + 1), slice(left, right + 1)
        weights = directions[patch] @ sides[face, :2] + sides[face, 2]
        total = weights.sum(axis=-1)
        hit = (weights >= 0).all(axis=-1) & (total > 0) & (total * NEAREST < volume[face])
        z = np.full(total.shape, np.inf)
        z[hit] = volume[face] / total[hit]
        nearest = hit & (z <= depth[patch])
        depth[patch][nearest] = z[nearest]
        which[patch][nearest] = face
    depth[np.isinf(depth)] = 0
    return depth, which


def _boxes(
    directions: Float[np.ndarray, "down across 2"], corners: Float[np.ndarray, "face 3 3"]
) -> Int[np.ndarray, "face 4"]:
    """The pixels that a face may cover: first and last column, first and last row.

    Found among the rays, not by projection, which lenses make ambiguous far outside of the view.
    A face that reaches behind the camera may cover all.
    """
    z = corners[..., 2]
    behind = z.min(axis=1) < NEAREST
    plane = corners[..., :2] / np.maximum(z, NEAREST)[..., None]
    boxes = []
    for axis, lines in ((0, directions[..., 0].T), (1, directions[..., 1])):
        # what a column (row) of pixels sees lies between these, made to grow from one to the next;
        # pixels without a ray see nothing
        least, most = (np.nan_to_num(lines, nan=value) for value in (np.inf, -np.inf))
        low = np.minimum.accumulate(least.min(axis=1)[::-1])[::-1]
        high = np.maximum.accumulate(most.max(axis=1))
        first = np.searchsorted(high, plane[..., axis].min(axis=1) - ROUNDING)
        last = np.searchsorted(low, plane[..., axis].max(axis=1) + ROUNDING, side="right") - 1
        boxes += [np.where(behind, 0, first), np.where(behind, len(lines) - 1, last)]
    return np.stack(boxes, axis=1)


CELL = 0.015  # [m]: width, at the sheet, of the cells in which samples hide each other
FARTHEST = 5.0  # [m], of a sheet from its cameras
DEPTH = 0.02  # [m]: samples this much behind the nearest in their cell are hidden


@dataclass(frozen=True)
class Views:
    """The cameras of a recording, and what became of their points.

    - `cameras`: in the world of the recording.
    - `clean`: how the cloud of each of them was cleaned.
    - `border`: width of the strip, along the borders of the sheet and of the workspace, which the
      outlier filter erodes and in which nothing is asked of a cloud, [m].
    - `hidden`: distance from a gripper within which the robot's mask hides the sheet, [m].
    - `taken`: of each frame the numbers of the cameras that took it; empty: all took all.
    """

    cameras: tuple[DepthCamera, ...]
    clean: Cleaning
    border: float = 0.0
    hidden: float = 0.0
    taken: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("views need a camera, found none")
        if min(self.border, self.hidden) < 0:
            raise ValueError(f"border and hidden must not be negative, found {self}")
        if any(not 0 <= i < len(self.cameras) for frame in self.taken for i in frame):
            raise ValueError(f"taken: there are {len(self.cameras)} cameras, from 0")
        low, high = np.array(self.clean.workspace)
        if not (low + 2 * self.border < high).all():
            raise ValueError(
                f"a workspace from {low} to {high} m has no room between borders of "
                f"{self.border:g} m"
            )


@dataclass(frozen=True)
class CameraFit:
    """How well what one camera alone shows fits the rest; None: it shows nothing of that.

    - `depth`: deviation from a plane at rest, or from the other cameras' surfaces, over the same if
      `depth_along` was the other of axis and ray.
    - `apart`: median distance from the other cameras' surfaces, [m].
    - `shift`, `turn`: of the sheet that lies at rest from its place, [m] and [degrees].
    """

    name: str
    depth: float | None = None
    apart: float | None = None
    shift: float | None = None
    turn: float | None = None


def shifted(views: Views, shift: Corner) -> Views:
    """The views of cameras, and of a workspace, that stand elsewhere by a shift [m]."""
    move = np.eye(4)
    move[:3, 3] = shift
    cameras = [
        replace(camera, to_world=rows_of(move @ np.array(camera.to_world)))
        for camera in views.cameras
    ]
    corners: Any = tuple(map(tuple, (np.array(views.clean.workspace) + shift).tolist()))
    return replace(views, cameras=tuple(cameras), clean=replace(views.clean, workspace=corners))


def taken_by(views: Views, frame: int) -> list[int]:
    """The numbers of the cameras that took a frame."""
    return list(views.taken[frame] if views.taken else range(len(views.cameras)))


def in_view(
    views: Views,
    samples: Float[Array, "sample 3"],
    grippers: Float[Array, "gripper 3"],
    taken: Bool[Array, " camera"] | None = None,
) -> Bool[Array, " sample"]:
    """Which samples [m] of a surface some camera of those that have `taken` the frame (None: all)
    must have recorded.

    In view, in the workspace less its border, away from the `grippers` [m], and not behind others:
    a z-buffer whose cells are `CELL` wide where the sheet is, so samples must be closer than that.
    """
    low, high = jnp.asarray(views.clean.workspace, samples.dtype)
    low, high = low[None] + views.border, high[None] - views.border
    kept = jnp.all((samples > low) & (samples < high), axis=1)
    apart = jnp.linalg.norm(samples[:, None] - grippers[None], axis=-1)
    kept &= jnp.all(apart > views.hidden, axis=1)
    by_camera = jnp.stack([_unhidden(camera, samples) for camera in views.cameras])
    if taken is not None:
        by_camera &= taken[:, None]
    return kept & jnp.any(by_camera, axis=0)


def _unhidden(camera: DepthCamera, samples: Float[Array, "sample 3"]) -> Bool[Array, " sample"]:
    pose = jnp.asarray(camera.to_world, samples.dtype)
    axes = (samples - pose[None, :3, 3]) @ pose[:3, :3]
    depth = axes[:, 2]
    lens = camera.focal_length, camera.centre, camera.resolution
    focal, centre, size = (jnp.asarray(part, samples.dtype)[None] for part in lens)
    pixel = axes[:, :2] / depth[:, None] * focal + centre
    inside = (depth > 0) & jnp.all((pixel > -0.5) & (pixel < size - 0.5), axis=1)
    # directions, not pixels: cells must not depend on how many pixels a camera has
    cell = CELL / jnp.maximum(jnp.median(depth), CELL)
    place = jnp.floor(axes[:, :2] / depth[:, None] / cell).astype(int)
    across = _cells(camera)
    index = (place[:, 1] + across) * 2 * across + place[:, 0] + across
    index = jnp.clip(index, 0, 4 * across**2 - 1)
    nearest = jax.ops.segment_min(jnp.where(inside, depth, jnp.inf), index, 4 * across**2)
    return inside & (depth <= nearest[index] + DEPTH)


def _cells(camera: DepthCamera) -> int:
    """Cells from the middle of the image to its edge, for sheets up to 5 m away."""
    size, focal, centre = map(np.array, (camera.resolution, camera.focal_length, camera.centre))
    slope = float((np.maximum(centre, size - centre) / focal).max())
    return math.ceil(slope * FARTHEST / CELL) + 1


def observed(
    views: Views, x: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"], frame: int = 0
) -> Float[np.ndarray, "point 3"]:
    """The points [m] that the cameras would have recorded of a mesh [m] in a frame: every pixel of
    those that took it that sees the mesh, cleaned as the recording was. Without a robot."""
    clouds = []
    for camera in (views.cameras[i] for i in taken_by(views, frame)):
        depth, _ = render(camera, x, faces)
        points = moved(np.array(camera.to_world), back_project(camera, depth, depth > 0))
        clouds.append(clean(points, views.clean, 0))
    return np.concatenate(clouds)
