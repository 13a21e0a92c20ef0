"""What calibrated cameras can have seen of a sheet, so that a simulated one is seen alike.

A cloud lies on its sheet wherever that is. That the sheet lies where the cloud is can be asked of
those parts alone that a camera had in view, that nothing hid, and that no filter took away.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.recordings.cameras.calibration import DepthCamera
from r2s.recordings.cameras.cleaning import Cleaning, Corner, clean
from r2s.recordings.cameras.depth import back_project, moved
from r2s.recordings.cameras.render import render

CELL = 0.015  # [m]: width, at the sheet, of the cells in which samples hide each other
DEPTH = 0.02  # [m]: samples this much behind the nearest in their cell are hidden


@dataclass(frozen=True)
class Views:
    """The cameras of a recording, and what became of their points.

    - `cameras`: in the world of the recording.
    - `clean`: how the cloud of each of them was cleaned.
    - `border`: width of the strip, along the borders of the sheet and of the workspace, which the
      outlier filter erodes and in which nothing is asked of a cloud, [m].
    - `hidden`: distance from a gripper within which the robot's mask hides the sheet, [m].

    Raises ValueError for no camera, a workspace with no room between its borders, and lengths that
    are negative.
    """

    cameras: tuple[DepthCamera, ...]
    clean: Cleaning
    border: float = 0.0
    hidden: float = 0.0

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("views need a camera, found none")
        if min(self.border, self.hidden) < 0:
            raise ValueError(f"border and hidden must not be negative, found {self}")
        low, high = np.array(self.clean.workspace)
        if not (low + 2 * self.border < high).all():
            raise ValueError(
                f"a workspace from {low} to {high} m has no room between borders of "
                f"{self.border:g} m"
            )


def shifted(views: Views, shift: Corner) -> Views:
    """The views of cameras, and of a workspace, that stand elsewhere by a shift [m]."""

    def beside(place: Corner) -> Corner:
        x, y, z = (float(a + b) for a, b in zip(place, shift, strict=True))
        return x, y, z

    cameras = []
    for camera in views.cameras:
        pose = np.array(camera.to_world)
        pose[:3, 3] += shift
        rows = tuple(tuple(float(value) for value in row) for row in pose)
        cameras.append(replace(camera, to_world=rows))
    low, high = views.clean.workspace
    clean = replace(views.clean, workspace=(beside(low), beside(high)))
    return replace(views, cameras=tuple(cameras), clean=clean)


def in_view(
    views: Views,
    samples: Float[Array, "sample 3"],
    grippers: Float[Array, "gripper 3"],
) -> Bool[Array, " sample"]:
    """Which samples [m] of a surface some camera must have recorded.

    In view, in the workspace less its border, away from the `grippers` [m], and not behind others:
    a z-buffer whose cells are `CELL` wide where the sheet is, so samples must be closer than that.
    """
    low, high = jnp.asarray(views.clean.workspace, samples.dtype)
    low, high = low[None] + views.border, high[None] - views.border
    kept = jnp.all((samples > low) & (samples < high), axis=1)
    apart = jnp.linalg.norm(samples[:, None] - grippers[None], axis=-1)
    kept &= jnp.all(apart > views.hidden, axis=1)
    by_camera = [_unhidden(camera, samples) for camera in views.cameras]
    return kept & jnp.any(jnp.stack(by_camera), axis=0)


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


def _cells(camera: DepthCamera, farthest: float = 5.0) -> int:
    """Cells from the middle of the image to its edge, for sheets up to so far away [m]."""
    slope = max(
        max(centre, size - centre) / focal
        for size, focal, centre in zip(
            camera.resolution, camera.focal_length, camera.centre, strict=True
        )
    )
    return math.ceil(slope * farthest / CELL) + 1


def observed(
    views: Views, x: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "point 3"]:
    """The points [m] that the cameras would have recorded of a mesh [m]: every pixel that sees it,
    cleaned camera by camera as the recording was. Without a robot."""
    clouds = []
    for camera in views.cameras:
        depth, _ = render(camera, x, faces)
        points = moved(np.array(camera.to_world), back_project(camera, depth, depth > 0))
        clouds.append(clean(points, views.clean, 0))
    return np.concatenate(clouds)
