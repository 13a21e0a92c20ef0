"""Distances from clouds to a simulated sheet, differentiable."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.geometry.surface import nearest, prolonged

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

    With its `borders` (`r2s.geometry.mesh.borders`) the sheet goes on beyond them, in the planes of
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
    strict = jnp.asarray(scale, float) > 0
    limit = jnp.where(strict, jnp.maximum(scale, TOUCHING), OUTLIER_SCALE)
    square = (distance / limit) ** 2
    return limit**2 / 2 * jnp.where(strict, square / (1 + square), jnp.log1p(square))


def robust_weight(
    distance: Float[Array, "*point"], scale: Float[Array, ""] | float = 0.0
) -> Float[Array, "*point"]:
    """The derivative of `robust`, divided by the distance [-]."""
    strict = jnp.asarray(scale, float) > 0
    limit = jnp.where(strict, jnp.maximum(scale, TOUCHING), OUTLIER_SCALE)
    weight = 1 / (1 + (distance / limit) ** 2)
    return jnp.where(strict, weight**2, weight)


def robust_curvature(
    distance: Float[Array, "*point"], scale: Float[Array, ""] | float = 0.0
) -> Float[Array, "*point"]:
    """The second derivative of `robust` [-]: below 0 for an outlier."""
    strict = jnp.asarray(scale, float) > 0
    limit = jnp.where(strict, jnp.maximum(scale, TOUCHING), OUTLIER_SCALE)
    square = (distance / limit) ** 2
    return jnp.where(strict, (1 - 3 * square) / (1 + square) ** 3, (1 - square) / (1 + square) ** 2)


Penalty = Callable[[Float[Array, " point"]], Float[Array, " point"]]  # of distances [m]


def squared(distance: Float[Array, "*point"]) -> Float[Array, "*point"]:
    """Half of the square, [m^2], so that it is `robust` for small distances [m]."""
    return distance**2 / 2


def huber(distance: Float[Array, "*point"], scale: float = 0.01) -> Float[Array, "*point"]:
    """Huber's penalty [m^2]: d^2 / 2 up to the `scale` [m], beyond it a straight line."""
    return jnp.where(distance < scale, distance**2 / 2, scale * (distance - scale / 2))


def masked_mean(values: Float[Array, "*point"], mask: Bool[Array, "*point"]) -> Float[Array, ""]:
    """The mean of the values in a mask; NaN when it is empty."""
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.sum(mask, dtype=values.dtype)


def trimmed_mean(
    values: Float[Array, " point"], mask: Bool[Array, " point"], share: float = 0.9
) -> Float[Array, ""]:
    """The mean of the least `share` of the values in a mask; NaN when it is empty.

    Raises `ValueError` for a share that is not above 0 and at most 1.
    """
    if not 0 < share <= 1:
        raise ValueError(f"a share is above 0 and at most 1, got {share}")
    order = jnp.sort(jnp.where(mask, values, jnp.inf))
    kept = jnp.ceil(share * jnp.sum(mask, dtype=values.dtype))
    return masked_mean(order, jnp.arange(len(values), dtype=values.dtype) < kept)


def to_surface(
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    x: Float[Array, "vertex 3"],
    faces: Int[Array, "face 3"],
    penalty: Penalty = robust,
    mean: Callable[..., Float[Array, ""]] = masked_mean,
) -> Float[Array, ""]:
    """A mean [m^2] of the distances from a cloud to a sheet, under a penalty.

    One-sided: what the cameras did not see of the sheet does not count.

    >>> corners = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> points, mask = jnp.array([[0.2, 0.2, 0.1], [9, 9, 9]]), jnp.array([True, False])
    >>> round(float(to_surface(points, mask, corners, jnp.array([[0, 1, 2]]), squared)), 4)
    0.005
    """
    return mean(penalty(surface_residuals(points, mask, x, faces)[0]), mask)


def from_surface(
    samples: Float[Array, "sample 3"],
    visible: Bool[Array, " sample"],
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    penalty: Penalty = squared,
    mean: Callable[..., Float[Array, ""]] = masked_mean,
) -> Float[Array, ""]:
    """A mean [m^2] of the distances from samples of a sheet to a cloud, under a penalty.

    Only samples that are `visible` count, such as those that
    `r2s.recordings.cameras.camera.Camera.sees`: of what no camera sees a cloud has no points.
    """
    targets = jnp.where(mask[:, None], points, jnp.inf)
    pairs = jnp.sum((jax.lax.stop_gradient(samples)[:, None] - targets[None]) ** 2, axis=-1)
    distance = length(samples - points[jnp.argmin(pairs, axis=1)])
    return mean(penalty(distance), visible)


def sinkhorn(
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    samples: Float[Array, "sample 3"],
    visible: Bool[Array, " sample"],
    blur: float = 0.02,
    iterations: int = 50,
) -> Float[Array, ""]:
    """The Sinkhorn divergence [m^2] between a cloud and samples of a sheet, half squares as cost.

    Each point goes to a place of its own, so that it sees global shape, which nearest points do
    not: a folded sheet does not lie well on an open one. Entropic transport at the scale `blur`
    [m], less that of each to itself (Feydy et al. 2019): zero when both are the same. Every point
    that is there, and every sample that is `visible`, weighs alike.
    """
    a, b = _log_weights(mask, points.dtype), _log_weights(visible, samples.dtype)
    both = _transport(points, a, samples, b, blur, iterations)
    alone = _transport(points, a, points, a, blur, iterations)
    return both - (alone + _transport(samples, b, samples, b, blur, iterations)) / 2


def _log_weights(mask: Bool[Array, " point"], dtype) -> Float[Array, " point"]:
    return jnp.where(mask, 0.0, -jnp.inf).astype(dtype) - jnp.log(jnp.sum(mask, dtype=dtype))


def _transport(x, a, y, b, blur: float, iterations: int) -> Float[Array, ""]:
    """The dual value [m^2] of entropic transport between weighted points, by Sinkhorn's iteration.

    Its derivative is that at fixed potentials (envelope theorem), which is exact at convergence.
    """
    epsilon = blur**2
    cost = lambda x, y: jnp.sum((x[:, None] - y[None]) ** 2, axis=-1) / 2

    def soften(weights, costs, potential):
        return -epsilon * jax.nn.logsumexp(weights[None] + (potential[None] - costs) / epsilon, 1)

    fixed = jax.lax.stop_gradient(cost(x, y))

    def step(potentials, _):
        f, g = potentials
        new = soften(b, fixed, g), soften(a, fixed.T, f)
        return tuple((old + now) / 2 for old, now in zip(potentials, new, strict=True)), None

    zeros = jnp.zeros(len(x), x.dtype), jnp.zeros(len(y), y.dtype)
    (_, g), _ = jax.lax.scan(step, zeros, None, length=iterations)
    g = jax.lax.stop_gradient(g)
    f = soften(b, cost(x, y), g)
    weigh = lambda weights, values: (
        jnp.sum(jnp.where(weights > -jnp.inf, values, 0)) * jnp.exp(jnp.max(weights))
    )
    return weigh(a, f) + weigh(b, g)
