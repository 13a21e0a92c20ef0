"""Distances of a prediction from clouds, markers and forces: robust loss, and normal equations."""

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

PATCHES = 3  # along a side of the sheet: residuals in one patch have correlated errors
MEMORY = 8  # frames in which they do
SLACK = 3e-3  # [m]: noise seldom moves a point of a depth camera farther beyond a border
FLATTEST = 0.3  # curvature of a robust loss over the mean weight, at least


class NormalEquations(eqx.Module):
    """A loss with its normal equations in theta, by clusters of residuals with correlated errors.

    A cluster is a patch of the sheet over some frames, a marker, or a force over some frames.

    - `loss`: [m^2].
    - `spread`: robust standard deviation of the distances, [m].
    - `scores`, `matrices`: share of each cluster in the loss's gradient and Gauss-Newton matrix,
      [m^2].
    - `noise`: variance [m^2] of each cluster's residuals; times its matrix it is the covariance
      [m^4] of its score if all residuals are independent.
    """

    loss: Float[Array, ""]
    spread: Float[Array, ""]
    scores: Float[Array, "cluster theta"]
    matrices: Float[Array, "cluster theta theta"]
    noise: Float[Array, " cluster"]


def loss_of(problem: Problem, prediction: Prediction, scale: Scale = 0.0) -> Float[Array, ""]:
    """The robust mean [m^2] of all distances to the observations.

    For `scale` [m] see `r2s.metrics.losses.robust`.
    """
    total = jnp.zeros((), prediction.x.dtype)
    if problem.clouds is not None:
        distance, mask = point_distances(problem, prediction, scale)
        total += masked_mean(robust(distance, scale), mask)
    if problem.markers is not None:
        gap = _gaps(problem.markers, prediction.x)
        total += masked_mean(robust(length(gap), scale), problem.markers.seen)
    if problem.expected is not None:
        gap, counts = _to_clouds(problem.expected, prediction.x)
        total += masked_mean(robust(length(gap), scale), counts)
    if problem.force is not None and prediction.force is not None:
        total += _force_loss(problem.force, _force_gaps(problem.force, prediction.force))
    return total


def normal_equations_of(
    problem: Problem, prediction: Prediction, slope: Sensitivity, scale: Scale = 0.0
) -> NormalEquations:
    """Loss and normal equations of all observations, from a prediction and its derivative."""
    mesh, clouds, parts = problem.scenario.scene.mesh, problem.clouds, []
    if clouds is not None:
        distance, direction, *samples = _residuals(clouds, mesh, prediction, scale)
        parts.append(_of_surface(mesh, slope, scale, distance, clouds.mask, -direction, *samples))
    if problem.markers is not None:
        parts.append(_of_markers(problem.markers, prediction, slope, scale))
    if problem.expected is not None:
        parts.append(_of_expected(problem.expected, mesh, prediction, slope, scale))
    if not (problem.force is None or prediction.force is None or slope.force is None):
        parts.append(_of_force(problem.force, prediction.force, slope.force))
    return NormalEquations(
        loss=sum((part.loss for part in parts), jnp.zeros((), prediction.x.dtype)),
        spread=parts[0].spread,
        scores=jnp.concatenate([part.scores for part in parts]),
        matrices=jnp.concatenate([part.matrices for part in parts]),
        noise=jnp.concatenate([part.noise for part in parts]),
    )


def marker_distances(problem: Problem, prediction: Prediction) -> tuple[Array, Array] | None:
    """Distance [m] of each marker from its place on the sheet, and where it was seen, by frame and
    marker; None without markers."""
    if problem.markers is None:
        return None
    return length(_gaps(problem.markers, prediction.x)), problem.markers.seen


def point_distances(
    problem: Problem, prediction: Prediction, scale: Scale = 0.0
) -> tuple[Array, Array]:
    """Distance [m] of each point from the sheet, and which are no padding, by frame and point;
    empty without clouds. For `scale` [m] see `r2s.metrics.losses.robust`."""
    if problem.clouds is None:
        return jnp.zeros((0, 0), prediction.x.dtype), jnp.zeros((0, 0), bool)
    mesh = problem.scenario.scene.mesh
    return _residuals(problem.clouds, mesh, prediction, scale)[0], problem.clouds.mask


def _of_expected(
    expected: ImageObservation, mesh: Mesh, prediction: Prediction, slope: Sensitivity, scale
) -> NormalEquations:
    gap, counts = _to_clouds(expected, prediction.x)
    distance = length(gap)
    direction = gap / jnp.maximum(distance, TOUCHING)[..., None]
    shape = len(gap), *expected.vertices.shape
    samples = (jnp.broadcast_to(part, shape) for part in (expected.vertices, expected.weights))
    return _of_surface(mesh, slope, scale, distance, counts, direction, *samples)


def _of_surface(
    mesh: Mesh, slope: Sensitivity, scale, distance, mask, direction, vertices, weights
) -> NormalEquations:
    """From distances that grow as places of the sheet (vertices, weights) move along directions;
    all with leading axes (frame, point)."""
    weight = _weights(distance, mask, scale)

    def frame(args):  # one at a time: its derivatives fit the cache
        slope, vertices, weights, direction, distance, weight = args
        moved = jnp.einsum("pk,pkiu->piu", weights, slope[vertices])
        jacobian = jnp.einsum("pi,piu->pu", direction, moved)
        place = jnp.einsum("pk,pki->pi", weights, mesh.rest[vertices])
        return _by_patch(mesh, place, jacobian, distance, weight)

    shares = jax.lax.map(frame, (slope.x, vertices, weights, direction, distance, weight))
    return _of_robust(distance, mask, scale, *(_by_time(share) for share in shares))


def _of_markers(
    markers: Markers, prediction: Prediction, slope: Sensitivity, scale
) -> NormalEquations:
    """Each marker is a cluster: an error of its place in the first frame is in all frames."""
    gap = _gaps(markers, prediction.x)
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


def _residuals(clouds: Clouds, mesh: Mesh, prediction: Prediction, scale: Scale):
    """`surface_residuals` of every frame; one frame at a time, which fits the cache.

    There is slack at the borders where outliers are left out, against a small bias.
    """
    edges, slack = borders(mesh), jnp.minimum(scale, SLACK)

    def frame(args):
        points, mask, x = args
        return surface_residuals(points, mask, x, mesh.faces, edges, slack)

    return jax.lax.map(frame, (clouds.points, clouds.mask, prediction.x))


def _to_clouds(
    expected: ImageObservation, x: Float[Array, "frame vertex 3"]
) -> tuple[Float[Array, "frame sample 3"], Bool[Array, "frame sample"]]:
    """From the nearest point of its cloud to each sample of the sheet [m], less the distance of
    neighbouring points; and which samples count, none in a frame without points."""

    def frame(args):
        x, targets, mask, apart, grippers, taken = args
        samples = jnp.einsum("sk,ski->si", expected.weights, x[expected.vertices])
        places = jax.lax.stop_gradient(samples)
        far = jnp.where(mask, 0, jnp.inf)
        pairs = jnp.sum((places[:, None] - targets[None]) ** 2, axis=-1) + far[None]
        gap = samples - targets[jnp.argmin(pairs, axis=1)]
        counts = in_view(expected.views, places, grippers, taken) & jnp.any(mask)
        away = length(gap)
        beyond = jnp.maximum(away - apart, 0) / jnp.maximum(away, TOUCHING)
        return jnp.where(counts[:, None], beyond[:, None] * gap, 0), counts

    kept = expected.targets, expected.mask, expected.apart, expected.grippers, expected.taken
    return jax.lax.map(frame, (x, *kept))


def _gaps(markers: Markers, x: Float[Array, "frame vertex 3"]) -> Float[Array, "frame marker 3"]:
    """From the observed to the predicted markers [m]; zero where they were not seen."""
    expected = jnp.einsum("mk,fmki->fmi", markers.weights, x[:, markers.vertices])
    return jnp.where(markers.seen[..., None], expected - markers.positions, 0)


def _force_gaps(force: Force, pulled: Array) -> Float[Array, "frame direction"]:
    """Excess of the simulated force, as a distance [m]; zero where none was measured."""
    return jnp.where(force.seen[:, None], FORCE_SCALE * (pulled - force.values), 0)


def _spread(distance: Float[Array, "*shape"], mask) -> Float[Array, ""]:
    """Standard deviation [m] of the normal distribution with the same median."""
    return 1.4826 * jnp.nanmedian(jnp.where(mask, distance, jnp.nan))
