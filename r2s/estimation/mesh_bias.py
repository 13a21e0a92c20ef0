"""How far an estimate would go on a finer mesh: one Gauss-Newton step with that mesh's motion.

The prediction is made on another mesh; its derivative is that of the estimate's mesh, interpolated
to the other's vertices. From that mesh the step is extrapolated to one of cell size 0 (Richardson),
by the order of the error in `r2s.scenarios.resolution`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation.gauss_newton import (
    MARGIN,
    Descent,
    is_finite,
    least_weight,
    loss_from,
    only_held,
    prior_terms,
    recording_weights,
    room,
)
from r2s.estimation.least_squares import bounded_step, common_axes
from r2s.estimation.prediction import (
    Derive,
    Prediction,
    Sensitivity,
    Theta,
    predict_compiled,
    predictions_at,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems, motion_alone
from r2s.estimation.standard_errors import equations
from r2s.materials.parameters import InformedSpace
from r2s.mesh.surface import nearest
from r2s.scenarios.resolution import ORDER

RISE, HALVINGS = 1.5, 6  # of a loss, and of the step that raises it by more
RCOND = 1e-6  # of the recordings' information: less than that is none


class OtherMesh(NamedTuple):
    """The same recordings on another mesh, and the extrapolation `factor` from a step to it."""

    problems: Problems
    factor: float

    @property
    def is_finer(self) -> bool:
        """Whether its cells are shorter."""
        return self.factor > 0


def factor(ratio: float) -> float:
    """Richardson extrapolation factor to cell size 0, of a step to cells `ratio` times as long."""
    return 1 / (1 - ratio**ORDER)


def coarser_of(
    problems: Problems, other: OtherMesh | None
) -> tuple[Problems, tuple[OtherMesh, ...]]:
    """The recordings on the coarser of two meshes, for what takes many motions, and each of them on
    another mesh beside it. Pulls stay on their own mesh."""
    if other is None:
        return problems, ()
    if other.is_finer:
        return problems, tuple(OtherMesh((there,), other.factor) for there in other.problems)
    coarse, beside = [], []
    for own, there in zip(problems, other.problems, strict=True):
        coarse.append(own if own.is_pulled else there)
        pair = (there, other.factor) if own.is_pulled else (own, factor(0.5))
        beside.append(OtherMesh((pair[0],), pair[1]))
    return tuple(coarse), tuple(beside)


class MeshError(NamedTuple):
    """The discretization error of theta.

    - `bias`: from the limit of fine meshes. `covariance`: its square, and its scatter between
      patches and blocks of frames.
    """

    bias: Float[np.ndarray, " theta"]
    covariance: Float[np.ndarray, "theta theta"]


def mesh_error(
    problems: Problems,
    other: OtherMesh,
    end: Descent,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
) -> MeshError:
    """The discretization error of theta, by one Gauss-Newton step.

    Its gradient is by how much that on the other mesh differs. The other mesh fits the recordings
    worse than by their noise, so the step has a prior as strong as that of a fit of this spread: a
    parameter of little influence is not taken for the cause. The scatter of the contributions of
    clusters of residuals is in the covariance. Parameters at a bound stay there.

    Where a motion fails, or the step is longer than the range, it is the whole range.

    - `predicted`: at the end, with its derivative.
    """
    size = theta_length(problems)
    changes, matrix, square = [], np.zeros((size, size)), 0.0
    for which, share in enumerate(recording_weights(problems)):
        index = theta_indices(problems, which)
        here, there, theta = problems[which], other.problems[which], end.theta[index]
        seen, slope = predicted[which]
        finer = predict_compiled(motion_alone(there), theta)
        own = equations(here, seen, slope, end.scale)
        found = equations(there, finer, _laid_onto(here, there, slope), end.scale)
        change = np.zeros((len(own.scores), size))
        change[:, index] = share * (np.asarray(found.scores) - np.asarray(own.scores))
        changes.append(change)
        matrix[np.ix_(index, index)] += share * np.asarray(found.matrices).sum(axis=0)
        square += float(share) * float(found.spread) ** 2
    least = least_weight(problems, jnp.sqrt(jnp.asarray(square, float)))
    matrix += float(least) * np.asarray(prior_terms(problems, end.theta)[1])
    change, limits = np.concatenate(changes), only_held(room(problems, end.theta))
    bias = other.factor * bounded_step(change.sum(axis=0), matrix, limits)
    if not np.isfinite(bias).all():
        return MeshError(np.ones(size), np.eye(size))
    bias = np.clip(bias, -1, 1)
    apart = other.factor * change @ np.linalg.inv(matrix)
    return MeshError(bias, np.outer(bias, bias) + apart.T @ apart)


def alone(
    problems: Problems,
    others: Sequence[OtherMesh],
    ends: Sequence[Descent],
    derive: Derive,
    width: float | None = None,
) -> list[Float[np.ndarray, " theta"]]:
    """The bias of the end of a descent in each recording alone; empty without other meshes."""
    if not others or not ends:
        return []
    return [
        mesh_error((problem,), other, end, derive((problem,), end.theta, width)).bias
        for problem, other, end in zip(problems, others, ends, strict=True)
    ]


def _laid_onto(here: Problem, there: Problem, slope: Sensitivity) -> Sensitivity:
    """A derivative on one mesh at the vertices of another."""
    meshes = here.scenario.scene.mesh, there.scenario.scene.mesh
    own, other = (mesh.lay_flat() for mesh in meshes)
    face, weights = nearest(other, own, meshes[0].faces)
    corners = meshes[0].faces[face]
    laid = jnp.einsum("vk,fvkiu->fviu", weights, slope.x[:, corners])
    return Sensitivity(laid, slope.force)


class Result(NamedTuple):
    """An estimate with its discretization error.

    - `theta`; `covariance`: with all errors; `bias`: of its mesh, no larger than the standard
      errors.
    """

    theta: Theta
    covariance: Float[np.ndarray, "theta theta"]
    bias: Float[np.ndarray, " theta"]


def correct(
    problems: Problems,
    other: OtherMesh,
    end: Descent,
    prior: Array,
    covariance: Float[np.ndarray, "theta theta"],
    by: MeshError,
) -> Result:
    """An estimate at the end of a descent, with its discretization error.

    It stays where the loss is least: a mesh's error does not say where the fabric is instead. A
    prior limits the error: in each direction it is the smaller of that by the recordings and that
    of the posterior in which the recordings have all of these errors (the model discrepancy of
    Kennedy and O'Hagan 2001, linear about the end), with the way to its mean. Only where tests
    measured this very fabric does it go there, as far as the finer mesh allows (`_allowed`).

    - `prior`: its weight. `covariance`: of the end, without its mesh's error. `by`: that.
    """
    raw, space = _positive(covariance) + by.covariance, problems[0].space
    if not (isinstance(space, InformedSpace) and is_finite(end.normal)):
        return Result(end.theta, raw, by.bias)
    way, errors = _posterior(problems, end, prior, raw)
    share = _allowed(other, end, way) if space.measured and other.is_finer else 0.0
    left = (1 - share) * way
    errors = errors + np.outer(left, left)
    if not share:
        errors = _smaller(raw, errors)
    most = np.sqrt(np.diag(errors))
    return Result(_at(other, end, share * way), errors, np.clip(by.bias, -most, most))


def _allowed(other: OtherMesh, end: Descent, way: Float[np.ndarray, " theta"]) -> float:
    """The share of a way from the end, halved as often as needed, at which the loss of the finer
    mesh is `RISE` times that at the end at most; 0 after `HALVINGS`."""

    def loss(share: float) -> float:
        theta = _at(other, end, share * way)
        return loss_from(other.problems, predictions_at(other.problems, theta), end.scale)

    most = RISE * loss(0.0)
    shares = (0.5**i for i in range(HALVINGS))
    return next((share for share in shares if loss(share) <= most), 0.0)


def _at(other: OtherMesh, end: Descent, way: Float[np.ndarray, " theta"]) -> Theta:
    """Theta at some way from an end, with the fabric's place within the unit cube."""
    if not way.any():
        return end.theta
    theta = np.asarray(end.theta, np.float64) + way
    is_fabric = np.arange(len(theta)) < other.problems[0].space.dim
    return jnp.asarray(np.where(is_fabric, np.clip(theta, MARGIN, 1 - MARGIN), theta), float)


def _posterior(
    problems: Problems, end: Descent, prior: Array, covariance: Float[np.ndarray, "theta theta"]
) -> tuple[Float[np.ndarray, " theta"], Float[np.ndarray, "theta theta"]]:
    """The way from an end of a given `covariance` to the mean of its posterior, and the covariance
    there. The information of the recordings is that of the covariance beyond the prior."""
    off, known = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    told = np.asarray(end.normal.matrix, np.float64) / float(prior)
    slope = np.asarray(end.normal.gradient, np.float64) / float(prior)
    alone = np.linalg.lstsq(told, -slope, rcond=RCOND)[0]  # the step without the prior
    sizes, axes = common_axes(known, np.linalg.inv(covariance))
    left = (axes * np.maximum(sizes - 1, 0)[None]) @ axes.T
    way = bounded_step(known @ off - left @ alone, left + known, room(problems, end.theta))
    return way, np.linalg.inv(left + known)


def _positive(covariance: Float[np.ndarray, "theta theta"]) -> Float[np.ndarray, "theta theta"]:
    """A covariance without the negative variances that rounding leaves in single precision."""
    deviation = np.sqrt(np.diag(covariance))
    sizes, axes = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    sizes = np.maximum(sizes, len(sizes) * np.finfo(np.float32).eps)
    return (axes * sizes[None]) @ axes.T * np.outer(deviation, deviation)


def _smaller(
    one: Float[np.ndarray, "theta theta"], other: Float[np.ndarray, "theta theta"]
) -> Float[np.ndarray, "theta theta"]:
    """The smaller of two covariances in each direction in which both have no correlation."""
    sizes, axes = common_axes(one, other)
    return (axes * np.minimum(sizes, 1)[None]) @ axes.T
