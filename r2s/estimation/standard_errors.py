"""Standard errors of an estimate: from the end of its descent, the places around it, and its law.

`covariance` is the sandwich estimator with the prior, plus the mean squared Gauss-Newton step from
nearby places, so that a rough or unconverged fit has larger errors. `model_error` is by how much a
constant stiffness differs from that at small strain: yarns stiffen as they stretch, so the first
half of a pull leads elsewhere than all of it.
"""

import dataclasses
from collections.abc import Sequence

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
    normal_from,
    normals_at,
    prior_terms,
    prior_weight,
    recording_weights,
)
from r2s.estimation.method import Budget
from r2s.estimation.normal_equations import normal_equations_of
from r2s.estimation.prediction import (
    Derive,
    Prediction,
    Sensitivity,
    Theta,
    derivatives_at,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems, seen_where
from r2s.materials.parameters import stiffens

FARTHEST = 2.0  # times the median distance, beyond which a step is shortened
# from the change of stiffness between half a pull and all of it, to that from small strain: twice
# as much where stiffness grows with the stretch
TO_SMALL_STRAIN = 2.0

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

    The sandwich estimator, plus the mean square of where Gauss-Newton steps from the end and from
    its neighbours lead. Where the loss is smooth they lead back to the end; where it is rough each
    leads elsewhere, as descents do. Steps longer than `FARTHEST` times the median, in standard
    errors, are shortened to that.

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
    found = sandwich + off.T @ off / len(off)
    _, precision = prior_terms(problems, end.theta)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, jnp.linalg.inv(precision))


@eqx.filter_jit
def steps_apart(
    problems: Problems, end: Descent, prior, neighbours: list[tuple[Theta, Normal]]
) -> Float[Array, "place theta"]:
    """How far Gauss-Newton steps from neighbours lead from where that of the end does."""
    led = [step_end(problems, *place, prior) for place in [(end.theta, end.normal), *neighbours]]
    return jnp.stack(led)[1:] - led[0][None]


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
    """Where the Gauss-Newton step from a place leads, regardless of bounds; none if the run or its
    derivatives diverged."""
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
) -> Float[np.ndarray, "theta theta"]:
    """`covariance` of theta at the end of a descent, with `budget.around` neighbours.

    - `tried_on`: the same recordings on the mesh of the neighbours, one standard error of that mesh
      away; None: the mesh of the descent.
    """
    there, here = tried_on or problems, end
    if there is not problems:
        predicted = derive(there, end.theta, budget.secant_width)
        normal = normal_from(there, end.theta, predicted, end.scale)
        here = dataclasses.replace(end, normal=normal)
    apart = jnp.zeros((0, len(end.theta)), float)
    if budget.num_probes:
        weight = prior_weight(there, here.normal)
        places = list(sample_around(there, here, weight, budget.num_probes, key))
        normals = normals_at(there, places, [end.scale] * len(places), budget.secant_width)
        apart = steps_apart(there, here, weight, list(zip(places, normals, strict=True)))
    prior = prior_weight(problems, end.normal)
    return np.asarray(covariance(problems, end, prior, apart, is_truth))


def to_small_strain(
    change: Float[np.ndarray, " place"], variance: Float[np.ndarray, " place"]
) -> Float[np.ndarray, " place"]:
    """How far places may be from those at small strain.

    - `change`: from where all of a pull leads to where its first half alone does.
    - `variance`: of this change by noise: the difference of both places' (Hausman 1978).
    """
    squares = change**2 - np.maximum(variance, 0)
    return TO_SMALL_STRAIN * np.sign(change) * np.sqrt(np.maximum(squares, 0))


def model_error(
    problems: Problems,
    end: Descent,
    prior: Array,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
) -> Float[np.ndarray, " theta"]:
    """How far theta may be from that at small strain, by one Gauss-Newton step from its end; zero
    without a pull's force, and for spaces of yarns that stiffen.

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
    force = jnp.linalg.norm(problem.force.values, axis=1)
    seen = problem.force.seen
    least = jnp.min(force, where=seen, initial=jnp.inf)
    greatest = jnp.max(force, where=seen, initial=0)
    early = force <= (least + greatest) / 2
    return seen_where(problem, lambda _: early)


def _step_of(
    problems: Problems, end: Descent, prior: Array, predicted
) -> tuple[Float[np.ndarray, " theta"], Float[np.ndarray, " theta"]]:
    """The Gauss-Newton step of problems from an end, and its variance by noise."""
    size = theta_length(problems)
    gradient, matrix, scatter = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
    for which, share in enumerate(np.asarray(recording_weights(problems), np.float64)):
        found = equations(problems[which], *predicted[which], end.scale)
        scores, parts, noise = (
            np.asarray(each, np.float64) for each in (found.scores, found.matrices, found.noise)
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
