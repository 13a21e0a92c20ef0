"""The surface of a sheet: points on it, and the nearest one to a point in space."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def nearest(
    points: Float[Array, "point 3"],
    x: Float[Array, "vertex 3"],
    faces: Int[Array, "face 3"],
) -> tuple[Int[Array, " point"], Float[Array, "point 3"]]:
    """The face nearest to each point, and the barycentric weights of the nearest place on it.

    Every pair of point and face is tried. Not differentiable, nor need it be: at the nearest place
    the distance does not change when the weights do (envelope theorem).
    """
    points, x = jax.lax.stop_gradient((points, x))
    corners = x[faces]

    def of_point(point):
        weights = jax.vmap(_closest_weights, in_axes=(None, 0))(point, corners)
        places = jnp.einsum("fk,fki->fi", weights, corners)
        best = jnp.argmin(jnp.sum((places - point[None]) ** 2, axis=-1))
        return best, weights[best]

    return jax.vmap(of_point)(points)


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


def sample_weights(resolution: int) -> Float[Array, "sample 3"]:
    """Barycentric weights of `resolution`^2 places spread evenly over a triangle."""
    steps = jnp.arange(resolution, dtype=float)
    i, j = (axis.ravel() for axis in jnp.meshgrid(steps, steps, indexing="ij"))
    upright = i + j < resolution  # the small triangles come upright and, between them, inverted
    first = jnp.where(upright, i + 1 / 3, resolution - i - 1 / 3) / resolution
    second = jnp.where(upright, j + 1 / 3, resolution - j - 1 / 3) / resolution
    return jnp.stack([1 - first - second, first, second], axis=1)


def sample(
    x: Float[Array, "vertex 3"], faces: Int[Array, "face 3"], resolution: int
) -> Float[Array, "sample 3"]:
    """`resolution`^2 evenly spread points [m] on each face."""
    weights = sample_weights(resolution)
    return jnp.einsum("sk,fki->fsi", weights, x[faces]).reshape(-1, 3)
