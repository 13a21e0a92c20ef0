"""Standard errors of an estimate: of its descent, of the fabric's law, and of the mesh.

`covariance` is the sandwich estimator with the prior, plus the mean squared Gauss-Newton step from
nearby places, so that a rough or unconverged fit has larger errors. `model_error` is the difference
between a constant stiffness and that at small strain: yarns stiffen as they stretch, so that the
first half of a pull gives another stiffness than all of it.

`mesh_error` is one Gauss-Newton step with the motion of another mesh. The derivative is that of the
estimate's mesh, interpolated to the other's vertices. The step is extrapolated to cell size 0
(Richardson), by the order of the error in `r2s.scenarios.resolution`.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.compilation import compile_once
from r2s.estimation.gauss_newton import (
    MARGIN,
    Descent,
    Normal,
    is_finite,
    least_weight,
    loss_from,
    normal_from,
    normals_at,
    only_held,
    prior_terms,
    prior_weight,
    recording_weights,
    room,
)
from r2s.estimation.least_squares import bounded_step, common_axes
from r2s.estimation.method import Budget
from r2s.estimation.normal_equations import normal_equations_of
from r2s.estimation.prediction import (
    Derive,
    Predicted,
    Prediction,
    Sensitivity,
    Theta,
    derivatives_at,
    in_proportion,
    predictions_at,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems, seen_where
from r2s.materials.parameters import InformedSpace, stiffens
from r2s.mesh.surface import nearest
from r2s.scenarios.resolution import ORDER

FARTHEST = 2.0  # times the median distance, beyond which a step is shortened
# from the change of stiffness between half a pull and all of it, to that from small strain: twice
# as much where stiffness grows with the stretch
TO_SMALL_STRAIN = 2.0
RISE, HALVINGS = 1.5, 6  # of a loss, and of the step that raises it by more
RCOND = 1e-6  # of the recordings' information: less than that is none

Vector = Float[np.ndarray, " theta"]
Matrix = Float[np.ndarray, "theta theta"]

equations = compile_once(normal_equations_of)


@eqx.filter_jit
def covariance(
    problems: Problems,
    end: Descent,
    prior,
    apart: Float[Array, "place theta"],
    is_truth: bool = False,
) -> Float[Array, "theta theta"]:
    """Covariance of theta at the end of one descent; that of the prior where derivatives are not
    finite.

    The sandwich estimator, plus the mean square of the Gauss-Newton steps from the end and from its
    neighbours. Where the loss is smooth they end where the descent did; where it is rough they
    scatter as descents do. Steps longer than `FARTHEST` times the median, in standard errors, are
    shortened to that.

    - `prior`: its weight, see `gauss_newton.prior_weight`.
    - `apart`: the `steps_apart` of the neighbours, on this mesh or another.
    - `is_truth`: the end is the true theta: its own step is noise.
    """
    own = step_end(problems, end.theta, end.normal, prior) - end.theta
    own = jnp.where(is_truth, 0, own)
    off = own[None] + jnp.concatenate([jnp.zeros_like(apart, shape=(1, len(own))), apart])
    sandwich, root = sandwich_of(problems, end, prior)
    far = jnp.linalg.norm(jnp.linalg.solve(root, off.T), axis=0)
    limit = FARTHEST * jnp.median(far)
    off = off * jnp.where(far > limit, limit / far, 1)[:, None]
    whole = sandwich + off.T @ off / len(off)
    _, precision = prior_terms(problems, end.theta)
    return jnp.where(jnp.all(jnp.isfinite(whole)), whole, jnp.linalg.inv(precision))


@eqx.filter_jit
def steps_apart(
    problems: Problems, end: Descent, prior, neighbours: list[tuple[Theta, Normal]]
) -> Float[Array, "place theta"]:
    """The ends of Gauss-Newton steps from neighbours, relative to that of the step from the end."""
    ends = [step_end(problems, *place, prior) for place in [(end.theta, end.normal), *neighbours]]
    return jnp.stack(ends)[1:] - ends[0][None]


@eqx.filter_jit
def sample_around(
    problems: Problems, end: Descent, prior, count: int, key: PRNGKeyArray
) -> Float[Array, "place theta"]:
    """An even `count` of places one standard error away from the end, in opposite pairs."""
    sandwich, root = sandwich_of(problems, end, prior)
    signs = jax.random.rademacher(key, (count // 2, len(sandwich)), sandwich.dtype)
    places = end.theta[None] + jnp.concatenate([signs, -signs]) @ root.T
    bounded = jnp.arange(len(sandwich)) < problems[0].space.dim
    return jnp.where(bounded[None], jnp.clip(places, MARGIN, 1 - MARGIN), places)


def sandwich_of(problems: Problems, end: Descent, prior):
    """The covariance of an estimate, had it converged and were the loss smooth, and its symmetric
    root, which rounding changes no more than it changes the covariance."""
    _, precision = prior_terms(problems, end.theta)
    inverse = jnp.linalg.inv(end.normal.matrix + prior * precision)
    sandwich = inverse @ (end.normal.scatter + prior**2 * precision) @ inverse
    deviation = jnp.sqrt(jnp.diag(sandwich))
    squares, axes = jnp.linalg.eigh(sandwich / jnp.outer(deviation, deviation))
    least = len(squares) * jnp.finfo(squares.dtype).eps
    root = (axes * jnp.sqrt(jnp.maximum(squares, least))[None]) @ axes.T
    return sandwich, deviation[:, None] * root


def step_end(problems: Problems, theta: Theta, normal: Normal, prior) -> Theta:
    """The end of the Gauss-Newton step from a place, without bounds; the place itself if the run or
    its derivatives diverged."""
    off, precision = prior_terms(problems, theta)
    matrix = normal.matrix + prior * precision
    step = jnp.linalg.solve(matrix, normal.gradient + prior * precision @ off)
    finite = jnp.isfinite(normal.loss) & jnp.all(jnp.isfinite(step))
    return theta - jnp.where(finite, step, 0)


def covariance_at(
    problems: Problems,
    budget: Budget,
    end: Descent,
    key: PRNGKeyArray,
    is_truth: bool = False,
    tried_on: Problems | None = None,
    derive: Derive = derivatives_at,
) -> Matrix:
    """`covariance` of theta at the end of a descent, with `budget.num_probes` neighbours.

    - `tried_on`: the same recordings on the mesh of the neighbours, one standard error of that mesh
      away; None: the mesh of the descent.
    """
    other, start, width = tried_on or problems, end, budget.secant_width
    if other is not problems:
        predicted = derive(other, end.theta, width)
        start = dataclasses.replace(end, normal=normal_from(other, end.theta, predicted, end.scale))
    apart = jnp.zeros((0, len(end.theta)), float)
    if budget.num_probes:
        weight = prior_weight(other, start.normal)
        places = list(sample_around(other, start, weight, budget.num_probes, key))
        near = _smooth_pulls(end.theta, derive(other, end.theta, width))
        normals = normals_at(other, places, [end.scale] * len(places), width, near)
        apart = steps_apart(other, start, weight, list(zip(places, normals, strict=True)))
    prior = prior_weight(problems, end.normal)
    return np.asarray(covariance(problems, end, prior, apart, is_truth))


def _smooth_pulls(theta: Theta, predicted: Predicted) -> Derive:
    """`derivatives_at` places around a theta, at which all is `predicted`: pulls change there in
    proportion, since a taut sheet does not buckle."""

    def derive(problems: Problems, place: Theta, width: float | None = None) -> Predicted:
        found = []
        for which, (problem, there) in enumerate(zip(problems, predicted, strict=True)):
            index = theta_indices(problems, which)
            if problem.is_pulled:
                found.append(in_proportion(there, (place - theta)[index]))
            else:
                found += derivatives_at((problem,), place[index], width)
        return found

    return derive


def to_small_strain(
    change: Float[np.ndarray, " place"], variance: Float[np.ndarray, " place"]
) -> Float[np.ndarray, " place"]:
    """The estimated distance of places from those at small strain.

    - `change`: from the place by all of a pull to that by its first half.
    - `variance`: of this change by noise: the difference of both places' (Hausman 1978).
    """
    squares = change**2 - np.maximum(variance, 0)
    return TO_SMALL_STRAIN * np.sign(change) * np.sqrt(np.maximum(squares, 0))


def model_error(problems: Problems, end: Descent, prior: Array, predicted: Predicted) -> Vector:
    """The estimated distance of theta from that at small strain, by one Gauss-Newton step from its
    end; zero without a pull's force, and for spaces of yarns that stiffen.

    - `prior`: its weight. `predicted`: at the end, with its derivative.
    """
    if stiffens(problems[0].space.ranges) or all(problem.force is None for problem in problems):
        return np.zeros(theta_length(problems))
    halves = tuple(half_pulled(problem) for problem in problems)
    half, half_variance = _step_of(halves, end, prior, predicted)
    whole, variance = _step_of(problems, end, prior, predicted)
    off = to_small_strain(half - whole, half_variance - variance)
    return np.clip(np.where(np.isfinite(off), off, 1.0), -1, 1)


def half_pulled(problem: Problem) -> Problem:
    """The problem of a pull up to the mean of its least and greatest force; any other as it is."""
    if problem.force is None:
        return problem
    force, seen = jnp.linalg.norm(problem.force.values, axis=1), problem.force.seen
    least = jnp.min(force, where=seen, initial=jnp.inf)
    greatest = jnp.max(force, where=seen, initial=0)
    early = force <= (least + greatest) / 2
    return seen_where(problem, lambda _: early)


def _step_of(
    problems: Problems, end: Descent, prior: Array, predicted: Predicted
) -> tuple[Vector, Vector]:
    """The Gauss-Newton step of problems from an end, and its variance by noise."""
    size = theta_length(problems)
    gradient, matrix, scatter = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
    for which, share in enumerate(np.asarray(recording_weights(problems), np.float64)):
        own = equations(problems[which], *predicted[which], end.scale)
        scores, parts, noise = (
            np.asarray(part, np.float64) for part in (own.scores, own.matrices, own.noise)
        )
        index = theta_indices(problems, which)
        gradient[index] += share * scores.sum(axis=0)
        matrix[np.ix_(index, index)] += share * parts.sum(axis=0)
        scatter[np.ix_(index, index)] += share**2 * np.einsum("c,cuv->uv", noise, parts)
    off, known = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    least = float(prior) * known
    inverse = np.linalg.inv(matrix + least)
    variance = inverse @ (scatter + float(prior) * least) @ inverse
    return -inverse @ (gradient + least @ off), np.diag(variance)


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
    """The recordings on the coarser of two meshes, for what takes many motions; and each of them on
    another mesh, to estimate the discretization error. Pulls stay on their own mesh."""
    if other is None:
        return problems, ()
    if other.is_finer:
        return problems, tuple(OtherMesh((finer,), other.factor) for finer in other.problems)
    coarse, beside = [], []
    for own, coarser in zip(problems, other.problems, strict=True):
        coarse.append(own if own.is_pulled else coarser)
        pair = (coarser, other.factor) if own.is_pulled else (own, factor(0.5))
        beside.append(OtherMesh((pair[0],), pair[1]))
    return tuple(coarse), tuple(beside)


def mesh_error(
    problems: Problems,
    other: OtherMesh,
    end: Descent,
    predicted: Predicted,
    moved: Sequence[Prediction] = (),
) -> tuple[Vector, Matrix]:
    """The discretization error of theta, by one Gauss-Newton step: its bias from the limit of fine
    meshes; and the square of that with its scatter between patches and blocks of frames.

    The gradient is the difference of the gradients on both meshes. The other mesh fits the
    recordings worse than by their noise, so the step has a prior as strong as that of a fit of this
    spread: a parameter of little influence is not taken for the cause. Parameters at a bound stay
    there. Where a motion fails, or the step is longer than the range, it is the whole range.

    - `predicted`: at the end, with its derivative.
    - `moved`: the predictions on the other mesh, where they are known.
    """
    size, moved = theta_length(problems), moved or predictions_at(other.problems, end.theta)
    changes, matrix, square = [], np.zeros((size, size)), 0.0
    for which, share in enumerate(recording_weights(problems)):
        index = theta_indices(problems, which)
        own, finer, (prediction, slope) = problems[which], other.problems[which], predicted[which]
        before = equations(own, prediction, slope, end.scale)
        after = equations(finer, moved[which], _laid_onto(own, finer, slope), end.scale)
        change = np.zeros((len(before.scores), size))
        change[:, index] = share * (np.asarray(after.scores) - np.asarray(before.scores))
        changes.append(change)
        matrix[np.ix_(index, index)] += share * np.asarray(after.matrices).sum(axis=0)
        square += float(share) * float(after.spread) ** 2
    least = least_weight(problems, jnp.sqrt(jnp.asarray(square, float)))
    matrix += float(least) * np.asarray(prior_terms(problems, end.theta)[1])
    change, limits = np.concatenate(changes), only_held(room(problems, end.theta))
    bias = other.factor * bounded_step(change.sum(axis=0), matrix, limits)
    if not np.isfinite(bias).all():
        return np.ones(size), np.eye(size)
    bias = np.clip(bias, -1, 1)
    apart = other.factor * change @ np.linalg.inv(matrix)
    return bias, np.outer(bias, bias) + apart.T @ apart


def _laid_onto(own: Problem, other: Problem, slope: Sensitivity) -> Sensitivity:
    """A derivative on the mesh of one problem at the vertices of another's."""
    meshes = own.scenario.scene.mesh, other.scenario.scene.mesh
    flat, onto = (mesh.lay_flat() for mesh in meshes)
    face, weights = nearest(onto, flat, meshes[0].faces)
    corners = meshes[0].faces[face]
    laid = jnp.einsum("vk,fvkiu->fviu", weights, slope.x[:, corners])
    return Sensitivity(laid, slope.force)


def with_mesh_error(
    problems: Problems,
    other: OtherMesh,
    end: Descent,
    prior: Array,
    covariance: Matrix,
    error: tuple[Vector, Matrix],
) -> tuple[Theta, Matrix, Vector]:
    """Theta, its covariance with all errors, and the bias of its mesh, no larger than the standard
    errors.

    Theta stays where the loss is least: a mesh's error does not say where the fabric is instead. A
    prior limits the error: in each direction it is the smaller of that by the recordings and that
    of the posterior in which the recordings have all of these errors (the model discrepancy of
    Kennedy and O'Hagan 2001, linear about the end), with the way to its mean. Only where tests
    measured this very fabric does theta go there, as far as the finer mesh allows (`_allowed`).

    - `prior`: its weight. `covariance`: of the end, without `error`, the `mesh_error`.
    """
    bias, of_mesh = error
    raw, space = _positive(covariance) + of_mesh, problems[0].space
    if not (isinstance(space, InformedSpace) and is_finite(end.normal)):
        return end.theta, raw, bias
    way, errors = _posterior(problems, end, prior, raw)
    share = _allowed(problems, other, end, way) if space.measured and other.is_finer else 0.0
    left = (1 - share) * way
    errors = errors + np.outer(left, left)
    if not share:
        errors = _smaller(raw, errors)
    most = np.sqrt(np.diag(errors))
    return _at(other, end, share * way), errors, np.clip(bias, -most, most)


def _allowed(problems: Problems, other: OtherMesh, end: Descent, way: Vector) -> float:
    """The share of a way from the end, halved as often as needed, at which the loss of the finer
    mesh is `RISE` times that at the end at most and the own mesh does not diverge; 0 after
    `HALVINGS`, or where the finer mesh diverges at the end."""

    def loss(on: Problems, share: float) -> float:
        theta = _at(other, end, share * way)
        return loss_from(on, predictions_at(on, theta), end.scale)

    most = RISE * loss(other.problems, 0.0)
    if not np.isfinite(most):
        return 0.0
    for share in (0.5**i for i in range(HALVINGS)):
        if loss(other.problems, share) <= most and np.isfinite(loss(problems, share)):
            return share
    return 0.0


def _at(other: OtherMesh, end: Descent, way: Vector) -> Theta:
    """Theta at some way from an end, with the fabric's place within the unit cube."""
    if not way.any():
        return end.theta
    theta = np.asarray(end.theta, np.float64) + way
    is_fabric = np.arange(len(theta)) < other.problems[0].space.dim
    return jnp.asarray(np.where(is_fabric, np.clip(theta, MARGIN, 1 - MARGIN), theta), float)


def _posterior(
    problems: Problems, end: Descent, prior: Array, covariance: Matrix
) -> tuple[Vector, Matrix]:
    """The way from an end of a given `covariance` to the mean of its posterior, and the covariance
    there. The information of the recordings is that of the covariance beyond the prior."""
    off, known = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    information = np.asarray(end.normal.matrix, np.float64) / float(prior)
    slope = np.asarray(end.normal.gradient, np.float64) / float(prior)
    alone = np.linalg.lstsq(information, -slope, rcond=RCOND)[0]  # the step without the prior
    sizes, axes = common_axes(known, np.linalg.inv(covariance))
    left = (axes * np.maximum(sizes - 1, 0)[None]) @ axes.T
    way = bounded_step(known @ off - left @ alone, left + known, room(problems, end.theta))
    return way, np.linalg.inv(left + known)


def _positive(covariance: Matrix) -> Matrix:
    """A covariance without the negative or zero variances that rounding leaves in single
    precision."""
    least = np.finfo(np.float32).eps  # an exact fit has no error at all
    deviation = np.sqrt(np.maximum(np.diag(covariance), least**2))
    sizes, axes = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    sizes = np.maximum(sizes, len(sizes) * least)
    return (axes * sizes[None]) @ axes.T * np.outer(deviation, deviation)


def _smaller(one: Matrix, other: Matrix) -> Matrix:
    """The smaller of two covariances in each direction in which both have no correlation."""
    sizes, axes = common_axes(one, other)
    return (axes * np.minimum(sizes, 1)[None]) @ axes.T
