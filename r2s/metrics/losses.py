"""Distances from clouds to a simulated sheet, differentiable."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import nearest, prolonged

TOUCHING = 1e-6  # [m]: what is nearer lies on the sheet

OUTLIER_SCALE = 0.015  # [m]: a point much farther away than this counts as an outlier


def one_sided_chamfer(
    points: Float[Array, "point 3"], mask: Bool[Array, " point"], targets: Float[Array, "target 3"]
) -> Float[Array, ""]:
    """Mean squared distance [m^2] from each (masked) point to the nearest target.

    Chamfer distance in one direction. Differentiable in both; NaN when the mask is empty.
    """
    frozen_points, frozen_targets = jax.lax.stop_gradient((points, targets))
    pairs = jnp.sum((frozen_points[:, None] - frozen_targets[None]) ** 2, axis=-1)
    distances = jnp.sum((points - targets[jnp.argmin(pairs, axis=1)]) ** 2, axis=-1)
    return jnp.sum(jnp.where(mask, distances, 0)) / jnp.sum(mask, dtype=distances.dtype)


def length(gap: Float[Array, "*point 3"]) -> Float[Array, "*point"]:
    """Lengths [m], 0 below `TOUCHING`, where the derivative of a root would not be finite."""
    square = jnp.sum(gap**2, axis=-1)
    apart = square > TOUCHING**2
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)


def surface_residuals(
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    x: Float[Array, "vertex 3"],
    faces: Int[Array, "face 3"],
    borders: Bool[Array, "face 3"] | None = None,
    slack: Float[Array, ""] | float = 0.0,
) -> tuple[Float[Array, " point"], Float[Array, "point 3"], Int[Array, "point 3"], Array]:
    """Distances [m] from points to a sheet, and what moves them.

    Gives the distance of each point (0 where masked out), the unit direction from the sheet to it,
    and the three vertices with their weights that make the nearest place: a small motion `dx` of
    the vertices changes the distance by -direction . sum(weights dx).

    With its `borders` (`r2s.mesh.mesh.borders`) the sheet goes on beyond them, in the planes of
    its faces, by `slack` [m]. Noise throws points beyond a border, where they pull at it, but what
    it throws inward does not push back: without slack, noise makes a sheet seem larger than it is.
    """
    face, weights = nearest(points, x, faces)
    if borders is not None:
        beyond = jnp.any(borders[face] & (weights <= 0), axis=1)
        longer = prolonged(points, x[faces[face]], weights, slack)
        weights = jnp.where(beyond[:, None], longer, weights)
    vertices = faces[face]
    gap = points - jnp.einsum("pk,pki->pi", weights, x[vertices])
    distance = length(gap)
    apart = distance > 0  # a point on the sheet has no direction but the normal
    edges = x[vertices[:, 1:]] - x[vertices[:, :1]]
    normal = jnp.cross(edges[:, 0], edges[:, 1])
    normal = normal / jnp.sqrt(jnp.sum(normal**2, axis=-1, keepdims=True))
    direction = jnp.where(apart[:, None], gap / jnp.where(apart, distance, 1)[:, None], normal)
    return jnp.where(mask, distance, 0), direction, vertices, weights


def robust(
    distance: Float[Array, "*point"], scale: Float[Array, ""] | float = 0.0
) -> Float[Array, "*point"]:
    """A robust loss [m^2]: d^2 / 2 for small distances d [m], less for outliers.

    Cauchy's, logarithmic beyond `OUTLIER_SCALE`, which draws from afar. Or, with a `scale` [m] > 0,
    that of Geman and McClure (1987), bounded: what is much farther off does not count at all.
    """
    strict, limit, square = _scaled(distance, scale)
    return limit**2 / 2 * jnp.where(strict, square / (1 + square), jnp.log1p(square))


def robust_weight(
    distance: Float[Array, "*point"], scale: Float[Array, ""] | float = 0.0
) -> Float[Array, "*point"]:
    """The derivative of `robust`, divided by the distance [-]."""
    strict, _, square = _scaled(distance, scale)
    weight = 1 / (1 + square)
    return jnp.where(strict, weight**2, weight)


def robust_curvature(
    distance: Float[Array, "*point"], scale: Float[Array, ""] | float = 0.0
) -> Float[Array, "*point"]:
    """The second derivative of `robust` [-]: below 0 for an outlier."""
    strict, _, square = _scaled(distance, scale)
    return jnp.where(strict, (1 - 3 * square) / (1 + square) ** 3, (1 - square) / (1 + square) ** 2)


def _scaled(distance, scale) -> tuple[Array, Array, Array]:
    """Whether the loss is the bounded one, its scale [m], and squared distances over that [-]."""
    strict = jnp.asarray(scale, float) > 0
    limit = jnp.where(strict, jnp.maximum(scale, TOUCHING), OUTLIER_SCALE)
    return strict, limit, (distance / limit) ** 2


def masked_mean(values: Float[Array, "*point"], mask: Bool[Array, "*point"]) -> Float[Array, ""]:
    """The mean of the values in a mask; NaN when it is empty."""
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.sum(mask, dtype=values.dtype)
