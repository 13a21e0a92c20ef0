"""Depth cameras: lenses, poses, rays, from depth images to points."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s._util.extras import require
from r2s._util.units import positive

Row = tuple[float, float, float, float]

DISTORTIONS = (0, 4, 5, 8, 12, 14)  # OpenCV's models: how many numbers each has
OFF_CENTRE = 0.2  # of the image's size: a lens's axis is closer to the middle than this
FARTHEST = 50.0  # [m]: no camera of a fabric stands farther from the origin
IN_MILLIMETRES = "give metres per unit of the depth files: 0.001 for millimetres, 1 for metres"


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera as OpenCV calibrates it: its x axis points right, y down, z forward.

    - `resolution`: pixels (across, down).
    - `focal_length`, `centre`: (across, down), in pixels; (0, 0) is the middle of the first pixel.
    - `to_world`: rows of the 4 x 4 matrix from the camera's axes to the world's, [m].
    - `depth_scale`: metres per unit of the depth files.
    - `distortion`: OpenCV's k1, k2, p1, p2, k3, ...; empty for none.
    - `masks`: is there a folder of masks (else every pixel may be the fabric)?
    - `may_miss`: may the fabric be out of this camera's view in some frames?

    Depth is the distance along z, not along the ray.
    """

    resolution: tuple[int, int]
    focal_length: tuple[float, float]
    centre: tuple[float, float]
    to_world: tuple[Row, Row, Row, Row]
    depth_scale: float = field(metadata={"unknown": IN_MILLIMETRES})
    distortion: tuple[float, ...] = ()
    masks: bool = True
    may_miss: bool = False

    def __post_init__(self) -> None:
        positive("pixel", resolution=min(self.resolution), focal_length=min(self.focal_length))
        if not self.depth_scale > 0:
            raise ValueError(
                f"depth_scale must be positive, found {self.depth_scale}: {IN_MILLIMETRES}"
            )
        if len(self.distortion) not in DISTORTIONS:
            raise ValueError(
                f"distortion has one of {DISTORTIONS} numbers, found {self.distortion}"
            )
        size = np.array(self.resolution)
        if (np.abs(np.array(self.centre) / size - 0.5) > OFF_CENTRE).any():
            raise ValueError(
                f"centre {self.centre} is far from the middle of {size[0]} x {size[1]} pixels: are "
                "these the intrinsics of another resolution? Scale focal_length and centre with it"
            )
        _check_pose(np.array(self.to_world))


def _check_pose(pose: np.ndarray) -> None:
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        hint = "transpose it" if np.array_equal(pose[:, 3], [0, 0, 0, 1]) else "give rows"
        raise ValueError(f"to_world must end with the row 0 0 0 1, found {pose[3]}: {hint}")
    if not is_rotation(pose[:3, :3], 1e-4):
        raise ValueError(
            f"to_world is no rotation and shift, found {pose[:3, :3].tolist()}: give the camera's "
            "x, y and z axes in the world as columns"
        )
    if np.abs(pose[:3, 3]).max() > FARTHEST:
        raise ValueError(
            f"to_world puts the camera at {pose[:3, 3]} m, more than {FARTHEST:g} m away: "
            "give its position in metres"
        )


def is_rotation(matrix: np.ndarray, tolerance: float) -> bool:
    """Whether the rows of a matrix are orthonormal, and its determinant is positive."""
    square = np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=tolerance)
    return square and bool(np.linalg.det(matrix) > 0)


def rows_of(pose: Float[np.ndarray, "4 4"]) -> Any:
    """A matrix as the tuples of `DepthCamera.to_world`."""
    return tuple(map(tuple, pose.tolist()))


def look_at(position: tuple[float, ...], target: tuple[float, ...]) -> tuple[Row, Row, Row, Row]:
    """`to_world` of a camera that looks at a target [m], not straight up or down; up stays up."""
    forward = np.subtract(target, position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"a camera at {position} looking at {target} has no way up in its image")
    axes = (right, np.cross(forward, right), forward)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    pose[:3, 3] = position
    return rows_of(pose)


def matrix(camera: DepthCamera) -> Float[np.ndarray, "3 3"]:
    """The 3 x 3 matrix of the intrinsics [pixel]."""
    (fx, fy), (cx, cy) = camera.focal_length, camera.centre
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@lru_cache(maxsize=8)  # the same for every frame; 15 MB at 720p
def rays(camera: DepthCamera) -> Float[np.ndarray, "down across 2"]:
    """x / z and y / z of what each pixel sees, in the camera's axes: undistorted.

    The image itself is left alone: interpolation would make depths between fabric and table.
    """
    columns, rows = (np.arange(size, dtype=float) for size in camera.resolution)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    directions = (pixels - camera.centre) / camera.focal_length
    if any(camera.distortion):
        cv2 = require("cv2", "camera", "lens distortion")
        lens = matrix(camera), np.array(camera.distortion)
        directions = cv2.undistortPoints(pixels.reshape(-1, 1, 2), *lens).reshape(pixels.shape)
    directions.setflags(write=False)
    return directions


def depth_jumps(
    depth: Float[np.ndarray, "down across"], limit: float
) -> Bool[np.ndarray, "down across"]:
    """Pixels at which the depth [m] jumps by more than `limit` [m] to a neighbour that has one.

    Such a pixel sees two surfaces, and cameras report a depth in between.
    """
    jumps = np.zeros(depth.shape, bool)
    for lines, marked in ((depth, jumps), (depth.T, jumps.T)):  # of two rows, of two columns
        jump = (np.abs(np.diff(lines, axis=0)) > limit) & (lines[1:] > 0) & (lines[:-1] > 0)
        marked[1:] |= jump
        marked[:-1] |= jump
    return jumps


def back_project(
    camera: DepthCamera,
    depth: Float[np.ndarray, "down across"],
    where: Bool[np.ndarray, "down across"],
) -> Float[np.ndarray, "point 3"]:
    """What the pixels `where` see, in the camera's axes [m], row by row."""
    along = depth[where].astype(np.float64)
    return np.concatenate([rays(camera)[where] * along[:, None], along[:, None]], axis=1)


def moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    """Points [m] after a rotation and shift given as a 4 x 4 matrix."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def from_world(camera: DepthCamera, points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    """World points [m] in the camera's axes."""
    pose = np.array(camera.to_world)
    return (points - pose[:3, 3]) @ pose[:3, :3]


DEPTH_TOLERANCE = 0.006  # [m]: samples of one surface in one pixel differ in depth by less


class Camera(eqx.Module):
    """A pinhole camera without distortion.

    - `position`, `target`: where it is and what it looks at, [m]; up in its image is up.
    - `focal_length`: in pixels.
    - `resolution`: pixels (across, down).
    """

    position: Float[Array, " 3"]
    target: Float[Array, " 3"]
    focal_length: float = eqx.field(static=True, default=200.0)
    resolution: tuple[int, int] = eqx.field(static=True, default=(160, 120))

    def project(
        self, points: Float[Array, "point 3"]
    ) -> tuple[Float[Array, "point 2"], Float[Array, " point"]]:
        """Pixel coordinates (across, down) and depth [m] of points [m]."""
        forward = self.target - self.position
        forward = forward / jnp.sqrt(forward @ forward)
        right = jnp.cross(forward, jnp.array([0.0, 0.0, 1.0], points.dtype))
        right = right / jnp.sqrt(right @ right)
        down = jnp.cross(forward, right)
        offset = points - self.position[None]
        depth = offset @ forward
        plane = jnp.stack([offset @ right, offset @ down], axis=1)
        centre = jnp.array(self.resolution, points.dtype) / 2
        return centre[None] + self.focal_length * plane / depth[:, None], depth

    def sees(self, points: Float[Array, "point 3"]) -> Bool[Array, " point"]:
        """Which points [m] of a densely sampled surface are in view and not behind others.

        A z-buffer: of the points in a pixel, those within `DEPTH_TOLERANCE` of the nearest.
        """
        pixel, depth = self.project(points)
        width, height = self.resolution
        across, down = jnp.floor(pixel[:, 0]).astype(int), jnp.floor(pixel[:, 1]).astype(int)
        inside = (depth > 0) & (across >= 0) & (across < width) & (down >= 0) & (down < height)
        index = jnp.where(inside, down * width + across, width * height)
        nearest = jax.ops.segment_min(depth, index, width * height + 1)
        return inside & (depth <= nearest[index] + DEPTH_TOLERANCE)
