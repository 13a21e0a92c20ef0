"""Distances from clouds to a simulated sheet: differentiable, and for reports."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import nearest, prolonged
from r2s.recordings.clouds import draw_points

TOUCHING = 1e-6  # [m]: nearer points lie on the sheet
OUTLIER_SCALE = 0.015  # [m]: a point much farther away than this counts as an outlier


def one_sided_chamfer(
    points: Float[Array, "point 3"], mask: Bool[Array, " point"], targets: Float[Array, "target 3"]
) -> Float[Array, ""]:
    """Mean squared distance [m^2] from each (masked) point to the nearest target.

    Differentiable in both; NaN when the mask is empty.
    """
    frozen_points, frozen_targets = jax.lax.stop_gradient((points, targets))
    pairs = jnp.sum((frozen_points[:, None] - frozen_targets[None]) ** 2, axis=-1)
    distances = jnp.sum((points - targets[jnp.argmin(pairs, axis=1)]) ** 2, axis=-1)
    return masked_mean(distances, mask)


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
    """Distances [m] from points to a sheet (0 where masked out), and their derivatives.

    Also the unit direction from the sheet to each point, and the three vertices and weights of the
    nearest place: a small motion `dx` of the vertices changes the distance by
    -direction . sum(weights dx).

    With its `borders` (`r2s.mesh.mesh.borders`) the sheet is extended beyond them, in the planes of
    its faces, by `slack` [m]: else noise, which pulls a border only outward, makes it seem larger.
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

    Cauchy's, logarithmic beyond `OUTLIER_SCALE`; with a `scale` [m] > 0 the bounded one of Geman
    and McClure (1987), by which far outliers do not count.
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


POINTS = 1000  # of a frame, at most: their mean is within 3 % of that of all


def to_surface(
    clouds: list[np.ndarray], x: Float[np.ndarray, "frame vertex 3"], faces: Int[Array, "face 3"]
) -> Float[np.ndarray, " frame"]:
    """Mean distance [m] from each frame's points to the nearest place on the sheet's surface.

    At most `POINTS` of them, drawn reproducibly. NaN where `x` is not finite. Raises `ValueError`
    for another number of clouds than frames, and for an empty one.
    """
    if len(clouds) != len(x):
        raise ValueError(f"got {len(clouds)} clouds for {len(x)} frames")
    if not all(len(cloud) for cloud in clouds):
        raise ValueError(f"frame {[len(c) for c in clouds].index(0)} has no points")
    most = min(POINTS, max(map(len, clouds)))
    drawn = [draw_points(cloud, most, (0, frame)) for frame, cloud in enumerate(clouds)]
    rows = [np.resize(cloud, (most, 3)) for cloud in drawn]  # repeated where too few
    weights = [_weights(min(len(cloud), most), most) for cloud in clouds]
    points = jnp.asarray(rows, float), jnp.asarray(weights, float)
    means = np.asarray(_mean_distances(*points, jnp.asarray(x), faces), float)
    return np.where(np.isfinite(x).all(axis=(1, 2)), means, np.nan)


def _weights(count: int, most: int) -> np.ndarray:
    """Shares of a mean over `count` points that are repeated to `most`."""
    times = np.bincount(np.arange(most) % count, minlength=count)
    return 1 / (count * np.resize(times, most))


@eqx.filter_jit
def _mean_distances(
    points: Float[Array, "frame point 3"],
    weights: Float[Array, "frame point"],
    x: Float[Array, "frame vertex 3"],
    faces: Int[Array, "face 3"],
) -> Float[Array, " frame"]:
    def of_frame(frame):
        points, weights, x = frame
        face, places = nearest(points, x, faces)
        gap = points - jnp.einsum("pk,pki->pi", places, x[faces[face]])
        return jnp.sum(weights * length(gap))

    return jax.lax.map(of_frame, (points, weights, x))
