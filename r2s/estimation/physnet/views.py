"""Depth images of points of a simulated surface, a recorded cloud or a camera's measurement.

All of them pass `depth_of`, which crops and scales simulated and recorded images alike.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import sample
from r2s.recordings.cameras import Camera
from r2s.scenarios.standard import Experiment
from r2s.scenarios.synthetic import sensing

Triple = tuple[float, float, float]
LAYER = 0.02  # [m], by which points of another layer lie behind the nearest of a pixel
MARGIN = 0.08  # around all points, as a share of the image and of the range of depths


@dataclass(frozen=True)
class View:
    """The camera of a square pinhole image, and the range of its depths.

    - `position`, `target`: the camera and the point at which it looks, [m]; up stays up.
    - `focal_length`: [pixel].
    - `size`: side of the image, [pixel].
    - `near`, `far`: depths that become white and black, [m].
    - `floor`: height below which points are left out, as fabric and table look alike there, [m].
    """

    position: Triple
    target: Triple
    focal_length: float
    size: int
    near: float
    far: float
    floor: float

    def __post_init__(self) -> None:
        if not (self.size >= 1 and self.focal_length > 0 and 0 < self.near < self.far):
            raise ValueError(
                "a view needs size >= 1, focal_length > 0 and 0 < near < far; got size "
                f"{self.size}, focal_length {self.focal_length:g}, near {self.near:g} m, far "
                f"{self.far:g} m"
            )


def eye_of(experiment: Experiment) -> Triple:
    """The position of the first camera of `r2s.scenarios.synthetic.sensing`, [m]."""
    x, y, z = (float(value) for value in sensing(experiment).cameras[0].position)
    return x, y, z


def view_around(eye: Triple, points: Float[np.ndarray, "point 3"], size: int, floor: float) -> View:
    """The view from a position that holds all points above the floor, with `MARGIN` around them.

    - `eye`: position of the camera, [m].
    - `points`: [m].
    - `size`: side of the image, [pixel].
    - `floor`: as in `View`, [m].

    Raises `ValueError` when no point is above the floor.
    """
    points = np.asarray(points, np.float64)
    points = points[points[:, 2] > floor]
    if not len(points):
        raise ValueError(f"no point is higher than {floor:g} m: there is nothing to look at")
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    aimed = Camera(jnp.asarray(eye, float), jnp.asarray(target, float), 1.0, (0, 0))
    plane, depth = (
        np.asarray(part, np.float64) for part in aimed.project(jnp.asarray(points, float))
    )
    spare = MARGIN * float(depth.max() - depth.min())
    x, y, z = (round(float(value), 6) for value in target)
    return View(
        position=eye,
        target=(x, y, z),
        focal_length=round(float(size / 2 / np.abs(plane).max() / (1 + MARGIN)), 6),
        size=size,
        near=round(float(depth.min()) - spare, 6),
        far=round(float(depth.max()) + spare, 6),
        floor=floor,
    )


def floor_of(experiment: Experiment) -> float:
    """The height [m] below which the cameras of an experiment see sheet and table alike."""
    return experiment.table_height + max(sensing(experiment).margin, -1.0)


def depth_of(
    view: View,
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    reach: Float[Array, ""] | None = None,
) -> Float[Array, "down across"]:
    """The depth [m] of the nearest layer of points [m] in each pixel, 0 where there is none.

    It is the mean of the points within `LAYER` of the nearest, which lessens noise. With `reach`
    [pixel], a point covers a square of twice that side: few points of a surface lie at its border,
    so that the surface would look smaller than it is.
    """
    eye, target = (jnp.asarray(place, points.dtype) for place in (view.position, view.target))
    camera = Camera(eye, target, view.focal_length, (view.size, view.size))
    pixel, depth = camera.project(points)
    inside = mask & (depth > 0) & (points[:, 2] > view.floor)
    if reach is not None:
        corners = reach * jnp.array([(-1, -1), (-1, 1), (1, -1), (1, 1)], pixel.dtype)
        pixel = (corners[:, None] + pixel[None]).reshape(-1, 2)
        inside, depth = jnp.tile(inside, len(corners)), jnp.tile(depth, len(corners))
    column, row = jnp.floor(pixel[:, 0]).astype(int), jnp.floor(pixel[:, 1]).astype(int)
    inside = inside & (jnp.minimum(column, row) >= 0) & (jnp.maximum(column, row) < view.size)
    count = view.size**2
    index = jnp.where(inside, row * view.size + column, count)
    nearest = jax.ops.segment_min(depth, index, count + 1)
    front = inside & (depth <= nearest[index] + LAYER)
    weight = front.astype(depth.dtype)
    both = jnp.stack([weight, jnp.where(front, depth, 0)], axis=1)
    number, total = jax.ops.segment_sum(both, index, count + 1)[:-1].T
    return (total / jnp.maximum(number, 1)).reshape(view.size, view.size)


def depths_of_sheet(
    view: View, x: Float[Array, "frame vertex 3"], faces: Int[Array, "face 3"], per_face: int
) -> Float[Array, "frame down across"]:
    """Depth images [m] of a moving mesh [m], from `per_face`^2 points on every face."""

    def of_frame(x):
        points = sample(x, faces, per_face)
        return depth_of(view, points, jnp.ones(len(points), bool))

    return jax.lax.map(of_frame, x)


def per_face(view: View, shape: tuple[int, int], size: tuple[float, float]) -> int:
    """The number of points along a face's edge that lie half a pixel apart.

    `shape` and `size` [m] are the vertices and sides of the mesh along warp and weft.
    """
    edge = max(side / (count - 1) for side, count in zip(size, shape, strict=True))
    return int(np.ceil(2 * edge * view.focal_length / view.near))
