"""Grey images of depth, as the network takes them: of a simulated surface or a recorded cloud.

Both pass `depth_of`, which crops and scales them in the same way, and `grey`.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import sample
from r2s.recordings.cameras import Camera
from r2s.recordings.recording import Recording
from r2s.scenarios.standard import Experiment
from r2s.scenarios.synthetic import sensing

Triple = tuple[float, float, float]
Depth = Float[Array, "down across"]  # [m]; 0 where there is none
LAYER = 0.02  # [m], by which points of another layer lie behind the nearest of a pixel
MARGIN = 0.08  # around all points, as a share of the image and of the range of depths
SUPPORT = 2  # least number of 8 neighbours within `LAYER` of a pixel that is no stray
SPECK = 5  # the same among 5 x 5 pixels, where `REACH` has spread measured points
FILLED = 5  # least number of 8 neighbours with depth, from which a hole is filled
PASSES = 2  # of filling: holes of up to about 4 pixels across
DARKEST = 0.2  # grey of the farthest depth; a pixel without depth is 0
REACH = 0.25  # half the side of the square of a measured point, over the distance between points
LEAST = 20  # least number of pixels with depth, in an image of 64 x 64


@dataclass(frozen=True)
class View:
    """The camera of a square pinhole image, and the range of its depths.

    - `position`, `target`: the camera and the point at which it looks, [m]; up stays up.
    - `focal_length`: [pixel].
    - `size`: side of the image, [pixel].
    - `near`, `far`: depths that become white and black, [m].
    - `floor`: height below which points are left out, as the table may be among them, [m].
    """

    position: Triple
    target: Triple
    focal_length: float
    size: int
    near: float
    far: float
    floor: float


def view_of(experiment: Experiment, points: Float[np.ndarray, "point 3"], size: int) -> View:
    """`view_around` points from the first camera of `r2s.scenarios.synthetic.sensing`, above the
    height below which its cameras see the table, too."""
    sensed = sensing(experiment)
    x, y, z = (float(value) for value in sensed.cameras[0].position)
    return view_around((x, y, z), points, size, experiment.table_height + max(sensed.margin, -1.0))


def view_around(eye: Triple, points: Float[np.ndarray, "point 3"], size: int, floor: float) -> View:
    """The view from `eye` [m] that holds all points [m] above the floor, with `MARGIN` around them.

    For `size` and `floor` see `View`. Raises `ValueError` when no point is above the floor.
    """
    points = np.asarray(points, np.float64)
    points = points[points[:, 2] > floor]
    if not len(points):
        raise ValueError(f"no point is higher than {floor:g} m: there is nothing to look at")
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    aimed = Camera(jnp.asarray(eye, float), jnp.asarray(target, float), 1.0, (0, 0))
    projected = aimed.project(jnp.asarray(points, float))
    plane, depth = (np.asarray(part, np.float64) for part in projected)
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


# Depth


def depth_of(
    view: View,
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    reach: Float[Array, ""] | None = None,
) -> Depth:
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


def depth_of_cloud(view: View, points: Float[Array, "point 3"], mask: Bool[Array, " point"]):
    """The depth image [m] of measured points [m], as large as that of the surface they lie on.

    Simulated surfaces are sampled up to their borders, which measured points do not reach. Pixels
    with fewer than `SPECK` around them near their depth are left out.
    """
    covered = jnp.sum(depth_of(view, points, mask) > 0)
    spacing = jnp.sqrt(covered / jnp.maximum(jnp.sum(mask), 1)).astype(points.dtype)
    depth = depth_of(view, points, mask, REACH * spacing)
    near = jnp.abs(_neighbours(depth, 2) - depth[None]) < 2 * LAYER
    return jnp.where((depth > 0) & (1 + jnp.sum(near, axis=0) >= SPECK), depth, 0)


# Grey images


def grey(view: View, depth: Depth) -> Float[Array, "down across"]:
    """The grey image of a depth image [m]: 1 for the nearest depth, `DARKEST` for the farthest,
    0 for none. Strays (with fewer than `SUPPORT` neighbours near their depth) are dropped, and then
    holes filled by the mean of at least `FILLED` neighbours.
    """
    beside = _neighbours(depth)
    near = (beside > 0) & (jnp.abs(beside - depth[None]) < LAYER)
    depth = jnp.where(jnp.sum(near, axis=0) >= SUPPORT, depth, 0)
    for _ in range(PASSES):
        number, mean = _mean_depth(_neighbours(depth))
        depth = jnp.where((depth > 0) | (number < FILLED), depth, mean)
    shade = (view.far - depth) / (view.far - view.near)
    return jnp.where(depth > 0, DARKEST + (1 - DARKEST) * jnp.clip(shade, 0, 1), 0)


def _neighbours(values: Depth, reach: int = 1) -> Float[Array, "n down across"]:
    """The neighbours of every pixel, 8 for a `reach` of 1; 0 outside of the image."""
    padded, (rows, columns) = jnp.pad(values, reach), values.shape
    shifts = [(i, j) for i in range(2 * reach + 1) for j in range(2 * reach + 1)]
    shifts.remove((reach, reach))
    return jnp.stack([padded[i : i + rows, j : j + columns] for i, j in shifts])


def _mean_depth(beside: Float[Array, "n down across"]):
    """How many neighbours of every pixel have a depth, and the mean of those [m]."""
    number = jnp.sum(beside > 0, axis=0, dtype=beside.dtype)
    return number, jnp.sum(beside, axis=0) / jnp.maximum(number, 1)


def of_clouds(
    view: View, recording: Recording, frames: tuple[int, ...]
) -> Float[np.ndarray, "frame down across"]:
    """The images of a recording's clouds at some frames.

    Raises `ValueError` that names the frame when its points are too few, not in metres, or not
    where the view looks.
    """
    clouds = recording.points[np.array(frames)], recording.mask[np.array(frames)]
    depths = np.asarray(jax.jit(jax.vmap(partial(depth_of_cloud, view)))(*clouds))
    least = LEAST * view.size**2 / 64**2
    for frame, depth in zip(frames, depths, strict=True):
        covered = depth[depth > 0]
        if len(covered) < least:
            raise ValueError(
                f"{recording.info.name}, frame {frame}: {len(covered)} pixels have a depth, "
                f"expected at least {least:.0f}: the frame is empty, the view looks elsewhere, or "
                "the units are not metres"
            )
        if not view.near / 2 <= np.median(covered) <= 2 * view.far:
            raise ValueError(
                f"{recording.info.name}, frame {frame}: the median depth is {np.median(covered):g} "
                f"m, the view expects {view.near:g} to {view.far:g} m: give points in metres"
            )
    return np.asarray(jax.jit(jax.vmap(partial(grey, view)))(jnp.asarray(depths, float)))


# Errors of training images


@dataclass(frozen=True)
class Flaws:
    """The errors of training images. Shares and scales are upper ends, drawn anew for each image.

    The defaults come from images of 64 x 64 of two cameras: 5 to 22 % of the pixels at a border are
    lost, up to 10 % beside it are gained, and a tenth of the depths there err by over 6 to 8 mm.

    - `noise`: standard deviation of depth at 1 m, which grows with its square, [m].
    - `holes`: share of the pixels that lose their depth.
    - `strays`: share of the pixels with a random depth, the same in every image.
    - `lost`: share of the pixels at a border, also one between layers, that lose their depth.
    - `gained`: share of the pixels just outside of a border that get the depth inside.
    - `flying`: scale of the Laplacian error of depth at a border, [m].
    """

    noise: float = 2e-3
    holes: float = 0.15
    strays: float = 0.003
    lost: float = 0.25
    gained: float = 0.1
    flying: float = 5e-3


def flawed(depth: Depth, view: View, flaws: Flaws, key: Array) -> Depth:
    """Depth [m] with noise, holes, strays and ragged borders, as cameras and clouds give it."""
    key_shares, key_border, key_noise, key_holes, key_stray, key_where = jax.random.split(key, 6)
    share = jax.random.uniform(key_shares, (4,), depth.dtype)
    depth = _with_ragged_borders(depth, flaws, share[:3], key_border)
    error = flaws.noise * depth**2 * jax.random.normal(key_noise, depth.shape, depth.dtype)
    keys = key_holes, key_stray, key_where
    hole, stray, where = (jax.random.uniform(k, depth.shape, depth.dtype) for k in keys)
    depth = jnp.where((hole >= flaws.holes * share[3]) & (depth > 0), depth + error, 0)
    return jnp.where(stray < flaws.strays, view.near + (view.far - view.near) * where, depth)


def _with_ragged_borders(depth: Depth, flaws: Flaws, share: Float[Array, "3"], key: Array) -> Depth:
    """Depth [m] with lost, gained and wrong pixels at its borders."""
    key_lost, key_error = jax.random.split(key)
    beside, is_sheet = _neighbours(depth), depth > 0
    number, mean = _mean_depth(beside)
    is_apart = (beside == 0) | (jnp.abs(beside - depth[None]) > LAYER)
    border = is_sheet & jnp.any(is_apart, axis=0)
    outside = ~is_sheet & (number > 0)
    chance = jax.random.uniform(key_lost, depth.shape, depth.dtype)
    gained = outside & (chance < flaws.gained * share[0])
    lost = border & (chance < flaws.lost * share[1])
    error = flaws.flying * share[2] * jax.random.laplace(key_error, depth.shape, depth.dtype)
    depth = jnp.where(gained, mean, jnp.where(lost, 0, depth))
    return jnp.where((border | outside) & (depth > 0), depth + error, depth)
