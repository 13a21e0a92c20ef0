"""A moved sheet: normals and masses; points on its surface, the nearest to a point."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r2s.mesh.mesh import Mesh

Positions = Float[Array, "vertex 3"]


def area_normals(mesh: Mesh, x: Positions) -> Float[Array, "element 3"]:
    """Normals of the elements that strains are taken in, as long as their areas, [m^2]."""
    corners = x[mesh.samples.corners]
    if corners.shape[1] == 4:  # across the diagonals of a quadrilateral
        return jnp.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) / 2
    return jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def vertex_masses(mesh: Mesh, density: Float[Array, ""]) -> Float[Array, " vertex"]:
    """Lumped mass [kg] of every vertex of a sheet, from its areal density [kg/m^2]."""
    return density * mesh.vertex_area


def nearest(
    points: Float[Array, "point 3"],
    x: Float[Array, "vertex 3"],
    faces: Int[Array, "face 3"],
) -> tuple[Int[Array, " point"], Float[Array, "point 3"]]:
    """The face nearest to each point, and the barycentric weights of the nearest place on it.

    Every pair of point and face is tried. Not differentiable, nor need it be: at the nearest place
    the distance does not change when the weights do (envelope theorem).

    >>> corners = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> face, weights = nearest(jnp.array([[0.25, 0.25, 0.1]]), corners, jnp.array([[0, 1, 2]]))
    >>> weights.tolist()
    [[0.5, 0.25, 0.25]]
    """
    points, x = jax.lax.stop_gradient((points, x))
    squared = _squared_distances(points, x[faces])
    # a minimum and a comparison vectorise, argmin does not: five times as fast on a CPU
    least = jnp.min(squared, axis=1, keepdims=True)
    face = jnp.argmax(squared <= least, axis=1)
    return face, jax.vmap(_closest_weights)(points, x[faces[face]])


def _squared_distances(
    points: Float[Array, "point 3"], corners: Float[Array, "face 3 3"]
) -> Float[Array, "point face"]:
    """From points to triangles, [m^2]: within the triangle its plane's, else its nearest edge's."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    tiny = jnp.finfo(points.dtype).tiny

    def dot(p, q):
        return jnp.sum(p * q, axis=-1)[None]  # of each face

    uu, uv, vv = dot(u, u), dot(u, v), dot(v, v)
    normal = jnp.cross(u, v)
    normal = normal / jnp.sqrt(jnp.maximum(dot(normal, normal)[0], tiny))[:, None]
    offset = [points[:, k, None] - a[None, :, k] for k in range(3)]  # each (point, face)

    def along(q):
        return sum(offset[k] * q[None, :, k] for k in range(3))

    s, t, height = along(u), along(v), along(normal)
    square = sum(part**2 for part in offset)
    first, second = vv * s - uv * t, uu * t - uv * s
    inside = (first >= 0) & (second >= 0) & (first + second <= uu * vv - uv**2)

    def to_edge(square, along, length):
        place = jnp.clip(along / jnp.maximum(length, tiny), 0, 1)
        return square - place * (2 * along - place * length)

    opposite = to_edge(square - 2 * s + uu, t - s - uv + uu, vv - 2 * uv + uu)
    edges = jnp.minimum(jnp.minimum(to_edge(square, s, uu), to_edge(square, t, vv)), opposite)
    return jnp.where(inside, height**2, edges)


def _closest_weights(point: Float[Array, " 3"], corners: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Barycentric weights of the place in a triangle that is nearest to a point."""
    a, b, c = corners
    inside = _plane_weights(point, a, b, c)
    edges = jnp.stack([_edge_weight(point, p, q) for p, q in ((a, b), (b, c), (c, a))])
    zero = jnp.zeros_like(edges[0])
    on_edges = jnp.stack(
        [
            jnp.stack([1 - edges[0], edges[0], zero]),
            jnp.stack([zero, 1 - edges[1], edges[1]]),
            jnp.stack([edges[2], zero, 1 - edges[2]]),
        ]
    )
    distances = jnp.sum((on_edges @ corners - point[None]) ** 2, axis=-1)
    return jnp.where(jnp.all(inside >= 0), inside, on_edges[jnp.argmin(distances)])


def prolonged(
    points: Float[Array, "point 3"],
    corners: Float[Array, "point 3 3"],
    weights: Float[Array, "point 3"],
    length: Float[Array, ""] | float,
) -> Float[Array, "point 3"]:
    """Barycentric weights of the place nearest to each point when its triangle, whose nearest place
    has `weights`, is extended in its plane by a `length` [m] beyond that place. Not differentiable,
    like `nearest`."""
    points, corners = jax.lax.stop_gradient((points, corners))
    edges = corners[:, 1:] - corners[:, :1]
    normal = jnp.cross(edges[:, 0], edges[:, 1])
    square = jnp.maximum(jnp.sum(normal**2, axis=-1), jnp.finfo(points.dtype).tiny)
    place = jnp.einsum("pk,pki->pi", weights, corners)
    gap = points - place
    along = gap - (jnp.sum(gap * normal, axis=-1) / square)[:, None] * normal
    far = jnp.sqrt(jnp.maximum(jnp.sum(along**2, axis=-1), jnp.finfo(points.dtype).tiny))
    moved = place + jnp.minimum(1, length / far)[:, None] * along
    return jax.vmap(_plane_weights)(moved, corners[:, 0], corners[:, 1], corners[:, 2])


def _plane_weights(point, a, b, c):
    """Barycentric weights of the foot of the perpendicular on the triangle's plane."""
    u, v, w = b - a, c - a, point - a
    uu, uv, vv, uw, vw = u @ u, u @ v, v @ v, u @ w, v @ w
    area = jnp.maximum(uu * vv - uv**2, jnp.finfo(w.dtype).tiny)
    s, t = (vv * uw - uv * vw) / area, (uu * vw - uv * uw) / area
    return jnp.stack([1 - s - t, s, t])


def _edge_weight(point, a, b):
    edge = b - a
    length = jnp.maximum(edge @ edge, jnp.finfo(edge.dtype).tiny)
    return jnp.clip((point - a) @ edge / length, 0, 1)


def sample(
    x: Float[Array, "vertex 3"], faces: Int[Array, "face 3"], resolution: int
) -> Float[Array, "sample 3"]:
    """`resolution`^2 evenly spread points [m] on each face."""
    steps = jnp.arange(resolution, dtype=float)
    i, j = (axis.ravel() for axis in jnp.meshgrid(steps, steps, indexing="ij"))
    upright = i + j < resolution  # the small triangles come upright and, between them, inverted
    first = jnp.where(upright, i + 1 / 3, resolution - i - 1 / 3) / resolution
    second = jnp.where(upright, j + 1 / 3, resolution - j - 1 / 3) / resolution
    weights = jnp.stack([1 - first - second, first, second], axis=1)
    return jnp.einsum("sk,fki->fsi", weights, x[faces]).reshape(-1, 3)
