"""Depth images of triangle meshes."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from r2s.recordings.cameras.calibration import DepthCamera, rays
from r2s.recordings.cameras.depth import from_world

NEAREST = 0.01  # [m]: what is nearer than this, or behind the camera, is not seen
ROUNDING = 1e-9
PAIRS = 1 << 19  # of face and pixel that are looked at together: about 100 MB


def render(
    camera: DepthCamera, x: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> tuple[Float[np.ndarray, "down across"], Int[np.ndarray, "down across"]]:
    """Depth [m] of what each pixel's middle sees of a mesh [m], and which face; 0 and -1 if none.

    A z-buffer, exact: depths are those at which the pixels' rays, bent by the lens, meet the
    triangles. Both sides of a face are seen.
    """
    across, down = camera.resolution
    corners = from_world(camera, np.asarray(x, np.float64))[faces]
    kept = np.flatnonzero(corners[..., 2].max(axis=1) > NEAREST)
    corners = corners[kept]
    depth = np.full(across * down, np.inf)
    which = np.full(across * down, -1, np.int32)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    # A ray d meets the plane of a, b, c with the barycentric weights d.(b x c), d.(c x a),
    # d.(a x b), but for a factor, and at the depth det(a, b, c) / (sum of them).
    sides = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("fi,fi->f", a, sides[:, 0])
    directions = rays(camera).reshape(-1, 2)
    for face, pixel in _pairs(_boxes(rays(camera), corners), across):
        ray = directions[pixel]
        weights = sides[face, :, 2] + np.einsum("pki,pi->pk", sides[face, :, :2], ray)
        weights *= np.sign(volume[face])[:, None]
        total = weights.sum(axis=1)
        inside = (weights >= 0).all(axis=1) & (total * NEAREST < np.abs(volume[face]))
        inside &= total > 0
        face, pixel = face[inside], pixel[inside]
        z = np.abs(volume[face]) / total[inside]
        np.minimum.at(depth, pixel, z)
        nearest = z == depth[pixel]
        which[pixel[nearest]] = kept[face[nearest]]
    depth[np.isinf(depth)] = 0
    return depth.reshape(down, across), which.reshape(down, across)


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
        # what a column (row) of pixels sees lies between these, made to grow from one to the next
        low = np.minimum.accumulate(lines.min(axis=1)[::-1])[::-1]
        high = np.maximum.accumulate(lines.max(axis=1))
        first = np.searchsorted(high, plane[..., axis].min(axis=1) - ROUNDING)
        last = np.searchsorted(low, plane[..., axis].max(axis=1) + ROUNDING, side="right") - 1
        boxes += [np.where(behind, 0, first), np.where(behind, len(lines) - 1, last)]
    return np.stack(boxes, axis=1)


def _pairs(boxes: np.ndarray, across: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Faces and the pixels in their boxes, some thousands of pairs at a time."""
    widths = np.maximum(boxes[:, 1] - boxes[:, 0] + 1, 0)
    counts = widths * np.maximum(boxes[:, 3] - boxes[:, 2] + 1, 0)
    group = np.cumsum(counts) // PAIRS
    for members in np.split(np.arange(len(boxes)), np.flatnonzero(np.diff(group)) + 1):
        face = np.repeat(members, counts[members])
        starts = np.repeat(np.cumsum(counts[members]) - counts[members], counts[members])
        place = np.arange(len(face)) - starts
        column = boxes[face, 0] + place % widths[face]
        yield face, (boxes[face, 2] + place // widths[face]) * across + column
