"""What a prediction says against what was seen: clouds, markers and forces, each a robust mean."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.estimation.prediction import Prediction, Sensitivity
from r2s.estimation.problem import FORCE_SCALE, Clouds, Force, ImageObservation, Markers, Problem
from r2s.mesh.mesh import Mesh, borders
from r2s.metrics.losses import (
    TOUCHING,
    length,
    masked_mean,
    robust,
    robust_curvature,
    robust_weight,
    surface_residuals,
)
from r2s.recordings.views import in_view

Scale = Float[Array, ""] | float
Loss = Callable[[Problem, Prediction], Float[Array, ""]]  # [m^2]

PATCHES = 3  # along a side of the sheet: what lies in one patch errs alike
MEMORY = 8  # frames, in which it does so
SLACK = 3e-3  # [m], which noise seldom throws a point of a depth camera beyond a border
FLATTEST = 0.3  # curvature of a robust loss over the mean weight, at least


class NormalEquations(eqx.Module):
    """A loss with its normal equations in theta, by clusters of residuals that err alike.

    A cluster is a patch of the sheet over some frames, a marker, or a force over some frames.

    - `loss`: [m^2].
    - `spread`: robust standard deviation of the distances, [m].
    - `scores`, `matrices`: share of each cluster in the loss's gradient and Gauss-Newton matrix,
      [m^2].
    - `noise`: variance [m^2] of each cluster's residuals; times its matrix it is the covariance
      [m^4] of its score if all residuals err independently.
    """

    loss: Float[Array, ""]
    spread: Float[Array, ""]
    scores: Float[Array, "cluster theta"]
    matrices: Float[Array, "cluster theta theta"]
    noise: Float[Array, " cluster"]


def loss_of(problem: Problem, seen: Prediction, scale: Scale = 0.0) -> Float[Array, ""]:
    """The robust mean [m^2] of all that was seen.

    For `scale` [m] see `r2s.metrics.losses.robust`.
    """
    mesh, total = problem.scenario.scene.mesh, jnp.zeros((), seen.x.dtype)
    if problem.clouds is not None:
        total += masked_mean(
            robust(_residuals(problem.clouds, mesh, seen, scale)[0], scale), problem.clouds.mask
        )
    if problem.markers is not None:
        gap = _gaps(problem.markers, seen.x)
        total += masked_mean(robust(length(gap), scale), problem.markers.seen)
    if problem.expected is not None:
        gap, counts = _to_clouds(problem.expected, seen.x)
        total += masked_mean(robust(length(gap), scale), counts)
    if problem.force is not None and seen.force is not None:
        total += _force_loss(problem.force, _force_gaps(problem.force, seen.force))
    return total


def normal_equations_of(
    problem: Problem, seen: Prediction, slope: Sensitivity, scale: Scale = 0.0
) -> NormalEquations:
    """Loss and normal equations of all that was seen, from a prediction and its derivative."""
    mesh = problem.scenario.scene.mesh
    parts = []
    if problem.clouds is not None:
        parts.append(_of_clouds(problem.clouds, mesh, seen, slope, scale))
    if problem.markers is not None:
        parts.append(_of_markers(problem.markers, seen, slope, scale))
    if problem.expected is not None:
        parts.append(_of_expected(problem.expected, mesh, seen, slope, scale))
    if problem.force is not None and seen.force is not None and slope.force is not None:
        parts.append(_of_force(problem.force, seen.force, slope.force))
    return NormalEquations(
        loss=sum((part.loss for part in parts), jnp.zeros((), seen.x.dtype)),
        spread=parts[0].spread,
        scores=jnp.concatenate([part.scores for part in parts]),
        matrices=jnp.concatenate([part.matrices for part in parts]),
        noise=jnp.concatenate([part.noise for part in parts]),
    )


def marker_distances(problem: Problem, seen: Prediction) -> tuple[Array, Array] | None:
    """How far [m] each marker is from its place on the sheet, and where it was seen, by frame and
    marker; None without markers."""
    if problem.markers is None:
        return None
    return length(_gaps(problem.markers, seen.x)), problem.markers.seen


def point_distances(problem: Problem, seen: Prediction, scale: Scale = 0.0) -> tuple[Array, Array]:
    """How far [m] each point is from the sheet, and which are no padding, by frame and point;
    empty without clouds. For `scale` [m] see `r2s.metrics.losses.robust`."""
    if problem.clouds is None:
        return jnp.zeros((0, 0), seen.x.dtype), jnp.zeros((0, 0), bool)
    mesh = problem.scenario.scene.mesh
    return _residuals(problem.clouds, mesh, seen, scale)[0], problem.clouds.mask


def _of_clouds(
    clouds: Clouds, mesh: Mesh, seen: Prediction, slope: Sensitivity, scale
) -> NormalEquations:
    distance, direction, vertices, weights = _residuals(clouds, mesh, seen, scale)
    return _of_surface(mesh, slope, scale, distance, clouds.mask, -direction, vertices, weights)


def _of_expected(
    expected: ImageObservation, mesh: Mesh, seen: Prediction, slope: Sensitivity, scale
) -> NormalEquations:
    gap, counts = _to_clouds(expected, seen.x)
    distance = length(gap)
    direction = gap / jnp.maximum(distance, TOUCHING)[..., None]
    shape = len(gap), *expected.vertices.shape
    samples = (jnp.broadcast_to(part, shape) for part in (expected.vertices, expected.weights))
    return _of_surface(mesh, slope, scale, distance, counts, direction, *samples)


def _of_surface(
    mesh: Mesh, slope: Sensitivity, scale, distance, mask, direction, vertices, weights
) -> NormalEquations:
    """Of distances that grow as places of the sheet, by vertices and weights, move along
    directions; all with leading axes (frame, point)."""
    weight = _weights(distance, mask, scale)

    def frame(args):  # one at a time: its derivatives fit the cache
        slope, vertices, weights, direction, distance, weight = args
        moved = jnp.einsum("pk,pkiu->piu", weights, slope[vertices])
        jacobian = jnp.einsum("pi,piu->pu", direction, moved)
        place = jnp.einsum("pk,pki->pi", weights, mesh.rest[vertices])
        return _by_patch(mesh, place, jacobian, distance, weight)

    shares = jax.lax.map(frame, (slope.x, vertices, weights, direction, distance, weight))
    return _of_robust(distance, mask, scale, *(_by_time(share) for share in shares))


def _of_markers(markers: Markers, seen: Prediction, slope: Sensitivity, scale) -> NormalEquations:
    """Each marker is a cluster: an error of its place in the first frame is in all frames."""
    gap = _gaps(markers, seen.x)
    distance = length(gap)
    picked = slope.x[:, markers.vertices]  # (frame, marker, corner, axis, theta)
    jacobian = jnp.einsum("mk,fmkiu->fmiu", markers.weights, picked)
    weight = _weights(distance, markers.seen, scale)
    scores = jnp.einsum("fm,fmi,fmiu->mu", weight, gap, jacobian)
    matrices = jnp.einsum("fm,fmiu,fmiv->muv", weight, jacobian, jacobian)
    return _of_robust(distance, markers.seen, scale, scores, matrices)


def _of_force(force: Force, pulled: Array, slope: Array) -> NormalEquations:
    gap, count = _force_gaps(force, pulled), jnp.sum(force.seen, dtype=float)
    jacobian = jnp.where(force.seen[:, None, None], FORCE_SCALE * slope, 0)
    scores = jnp.einsum("fd,fdu->fu", gap, jacobian) / count
    matrices = jnp.einsum("fdu,fdv->fuv", jacobian, jacobian) / count
    matrices = _by_time(matrices[:, None])
    square = jnp.sum(gap**2) / (count * gap.shape[1])
    return NormalEquations(
        loss=_force_loss(force, gap),
        spread=jnp.sqrt(square),
        scores=_by_time(scores[:, None]),
        matrices=matrices,
        noise=jnp.full(len(matrices), square / count),
    )


def _force_loss(force: Force, gap: Float[Array, "frame direction"]) -> Float[Array, ""]:
    return masked_mean(jnp.sum(gap**2, axis=1), force.seen) / 2


def _weights(distance: Float[Array, "frame point"], mask, scale: Scale) -> Array:
    """Weight of each point in the normal equations of the mean."""
    return jnp.where(mask, robust_weight(distance, scale), 0) / jnp.sum(mask, dtype=float)


def _of_robust(distance, mask, scale: Scale, scores: Array, matrices: Array) -> NormalEquations:
    """Normal equations of distances, from the shares of the clusters in their weighted squares.

    Their matrix is steeper than the robust loss is curved: by the ratio of its mean curvature to
    the mean weight, with which the estimate has the covariance of an M-estimate (Huber 1981).
    """
    count = jnp.sum(mask, dtype=float)
    weight = masked_mean(robust_weight(distance, scale), mask)
    curvature = masked_mean(robust_curvature(distance, scale), mask)
    curvature = jnp.clip(curvature, FLATTEST * weight, weight)
    square = masked_mean((robust_weight(distance, scale) * distance) ** 2, mask)
    matrices = matrices * (curvature / weight)
    return NormalEquations(
        loss=masked_mean(robust(distance, scale), mask),
        spread=_spread(distance, mask),
        scores=scores,
        matrices=matrices,
        noise=jnp.full(len(matrices), square / curvature / count),
    )


def _by_patch(
    mesh: Mesh,
    place: Float[Array, "point 2"],
    jacobian: Float[Array, "point theta"],
    distance: Float[Array, " point"],
    weight: Float[Array, " point"],
) -> tuple[Float[Array, "patch theta"], Float[Array, "patch theta theta"]]:
    """Scores and matrices of a frame's patches, from distances at places of the sheet [m]."""
    extent = jnp.max(mesh.rest, axis=0) * (1 + 1e-3)
    cell = jnp.clip(jnp.floor(place / extent[None] * PATCHES).astype(int), 0, PATCHES - 1)
    patch = jax.nn.one_hot(cell[:, 0] * PATCHES + cell[:, 1], PATCHES**2, dtype=distance.dtype)
    score = (weight * distance)[:, None] * jacobian
    matrix = jnp.einsum("p,pu,pv->puv", weight, jacobian, jacobian)
    return patch.T @ score, jnp.einsum("pc,puv->cuv", patch, matrix)


def _by_time(shares: Float[Array, "frame patch *rest"]) -> Float[Array, " *cluster"]:
    """Sums over blocks of frames, which with their patches are the clusters."""
    missing = -len(shares) % MEMORY
    whole = jnp.pad(shares, ((0, missing), *((0, 0),) * (shares.ndim - 1)))
    blocks = jnp.sum(whole.reshape(-1, MEMORY, *shares.shape[1:]), axis=1)
    return blocks.reshape(-1, *shares.shape[2:])


def _residuals(clouds: Clouds, mesh: Mesh, seen: Prediction, scale: Scale):
    """`surface_residuals` of every frame; one frame at a time, which fits the cache.

    There is slack at the borders where outliers are left out, since a small bias would show there.
    """
    edges, slack = borders(mesh), jnp.minimum(scale, SLACK)

    def frame(args):
        points, mask, x = args
        return surface_residuals(points, mask, x, mesh.faces, edges, slack)

    return jax.lax.map(frame, (clouds.points, clouds.mask, seen.x))


def _to_clouds(
    expected: ImageObservation, x: Float[Array, "frame vertex 3"]
) -> tuple[Float[Array, "frame sample 3"], Bool[Array, "frame sample"]]:
    """From the nearest point of its cloud to each sample of the sheet [m], and which count.

    Nothing counts in a frame without points. How far points are apart from each other says nothing
    of the sheet: gaps are shorter by that.
    """

    def frame(args):
        x, targets, mask, apart, grippers = args
        samples = jnp.einsum("sk,ski->si", expected.weights, x[expected.vertices])
        places = jax.lax.stop_gradient(samples)
        far = jnp.where(mask, 0, jnp.inf)
        pairs = jnp.sum((places[:, None] - targets[None]) ** 2, axis=-1) + far[None]
        gap = samples - targets[jnp.argmin(pairs, axis=1)]
        counts = in_view(expected.views, places, grippers) & jnp.any(mask)
        away = length(gap)
        beyond = jnp.maximum(away - apart, 0) / jnp.maximum(away, TOUCHING)
        return jnp.where(counts[:, None], beyond[:, None] * gap, 0), counts

    seen = expected.targets, expected.mask, expected.apart, expected.grippers
    return jax.lax.map(frame, (x, *seen))


def _gaps(markers: Markers, x: Float[Array, "frame vertex 3"]) -> Float[Array, "frame marker 3"]:
    """From where markers were seen to where they should be [m]; zero where they were not seen."""
    expected = jnp.einsum("mk,fmki->fmi", markers.weights, x[:, markers.vertices])
    return jnp.where(markers.seen[..., None], expected - markers.positions, 0)


def _force_gaps(force: Force, pulled: Array) -> Float[Array, "frame direction"]:
    """Excess of the simulated force, as a distance [m]; zero where none was measured."""
    return jnp.where(force.seen[:, None], FORCE_SCALE * (pulled - force.values), 0)


def _spread(distance: Float[Array, "*shape"], mask) -> Float[Array, ""]:
    """Standard deviation [m] of the normal distribution with the same median."""
    return 1.4826 * jnp.nanmedian(jnp.where(mask, distance, jnp.nan))
