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

LENSES = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (0, 4)}  # OpenCV's, and their numbers
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
    - `lens`: "pinhole", also with the rational, thin prism and tilted models, by the number of
      `distortion`; or "fisheye" (OpenCV's `cv2.fisheye`, k1 to k4).
    - `depth_along`: "axis" where files have the distance along z, as depth cameras give it; "ray"
      where they have the distance from the camera, as some simulators do.
    - `masks`: is there a folder of masks (else every pixel may be the fabric)?
    - `may_miss`: may the fabric be out of this camera's view in some frames?
    """

    resolution: tuple[int, int]
    focal_length: tuple[float, float]
    centre: tuple[float, float]
    to_world: tuple[Row, Row, Row, Row]
    depth_scale: float = field(metadata={"unknown": IN_MILLIMETRES})
    distortion: tuple[float, ...] = ()
    masks: bool = True
    may_miss: bool = False
    lens: str = "pinhole"
    depth_along: str = "axis"

    def __post_init__(self) -> None:
        positive("pixel", resolution=min(self.resolution), focal_length=min(self.focal_length))
        if not self.depth_scale > 0:
            raise ValueError(
                f"depth_scale must be positive, found {self.depth_scale}: {IN_MILLIMETRES}"
            )
        if self.lens not in LENSES:
            raise ValueError(f"lens must be one of {list(LENSES)}, found {self.lens!r}")
        if self.depth_along not in ("axis", "ray"):
            raise ValueError(f"depth_along must be 'axis' or 'ray', found {self.depth_along!r}")
        if len(self.distortion) not in LENSES[self.lens]:
            raise ValueError(
                f"distortion of a {self.lens} lens has one of {LENSES[self.lens]} numbers, found "
                f"{self.distortion}"
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


INVERTED = 0.01  # [pixel], within which a pixel's ray is seen in that pixel
WIDEST = np.radians(88.0)  # from the axis: beyond, x / z says little
BLOCK = 50_000  # pixels that are inverted at once: derivatives take 400 bytes each
STEPS = 30  # of Newton's method, at most


@lru_cache(maxsize=8)  # the same for every frame; 15 MB at 720p
def rays(camera: DepthCamera) -> Float[np.ndarray, "down across 2"]:
    """x / z and y / z of what each pixel sees, in the camera's axes: undistorted, to `INVERTED`.

    NaN where the lens has no inverse, or looks more than `WIDEST` aside. The image itself is left
    alone: interpolation would make depths between fabric and table.
    """
    columns, rows = (np.arange(size, dtype=float) for size in camera.resolution)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    directions = (pixels - camera.centre) / camera.focal_length
    if any(camera.distortion) or camera.lens == "fisheye":
        blocks = np.array_split(directions.reshape(-1, 2), directions.size // 2 // BLOCK + 1)
        parts = [_undistorted(camera, block) for block in blocks]
        directions = np.concatenate(parts).reshape(directions.shape)
    directions.setflags(write=False)
    return directions


def project(camera: DepthCamera, points: Float[np.ndarray, "*_ 3"]) -> Float[np.ndarray, "*_ 2"]:
    """The pixel (across, down), lens included, of points in the camera's axes [m], before it."""
    flat = (points[..., :2] / points[..., 2:]).reshape(-1, 2)
    if any(camera.distortion) or camera.lens == "fisheye":
        flat = _distorted(camera, flat, camera.distortion)[0]
    return flat.reshape(*points.shape[:-1], 2) * camera.focal_length + camera.centre


def _distorted(
    camera: DepthCamera, places: Float[np.ndarray, "place 2"], distortion: tuple[float, ...]
) -> tuple[Float[np.ndarray, "place 2"], Float[np.ndarray, "place 2 2"]]:
    """Where a lens puts x / z and y / z, for a focal length of 1, and the derivatives."""
    cv2 = require("cv2", "camera", "lens distortion")
    # derivatives by a shift come after focal length, centre, distortion and turn, or after the turn
    model, shift = (cv2.fisheye, 11) if camera.lens == "fisheye" else (cv2, 3)
    points, still = np.column_stack([places, np.ones(len(places))])[:, None], np.zeros((3, 1))
    numbers = np.array(distortion or (0.0,) * 4)
    put, slopes = model.projectPoints(points, still, still, np.eye(3), numbers)[:2]
    return put.reshape(-1, 2), slopes[:, shift : shift + 2].reshape(-1, 2, 2)


def _undistorted(
    camera: DepthCamera, seen: Float[np.ndarray, "place 2"]
) -> Float[np.ndarray, "place 2"]:
    """The inverse of `_distorted`, on the branch of the centre, by Newton's method; NaN: none.

    It starts from the inverse of the radial part, which is a function of one number.
    """
    slope, numbers = np.tan(np.linspace(0, WIDEST, 4000)), camera.distortion
    if camera.lens == "pinhole":  # 2, 3: tangential; 8 and on: thin prism and tilt
        numbers = tuple(0.0 if i in (2, 3) or i > 7 else k for i, k in enumerate(numbers))
    radius = _distorted(camera, np.column_stack([slope, 0 * slope]), numbers)[0][:, 0]
    rises = np.append(np.diff(radius) > 0, False)
    end = int(rises.argmin()) + 1
    size = np.linalg.norm(seen, axis=1, keepdims=True)
    start = np.minimum(np.interp(size, radius[:end], slope[:end]), 0.97 * slope[end - 1])
    places = seen * start / np.maximum(size, 1e-12)  # not at the end, where derivatives vanish
    good, left = np.zeros(len(seen), bool), np.arange(len(seen))
    with np.errstate(all="ignore"):  # what diverges is not good
        for _ in range(STEPS):
            put, slopes = _distorted(camera, places[left], camera.distortion)
            off, ((a, b), (c, d)) = (put - seen[left]).T, slopes.transpose(1, 2, 0)
            det = a * d - b * c
            miss = np.hypot(*(off.T * camera.focal_length).T)
            good[left] = (miss < INVERTED / 1e3) & (det > 0)
            step = np.stack([d * off[0] - b * off[1], a * off[1] - c * off[0]]) / det
            places[left] -= np.where(good[left], 0, np.clip(step, -1, 1)).T
            if not len(left := left[~good[left]]):
                break
        good &= np.linalg.norm(places, axis=1) <= slope[end - 1]
    return np.where(good[:, None], places, np.nan)


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
