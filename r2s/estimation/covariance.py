"""The covariance of an estimate, from as many frames of its recordings as agree."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import gauss_newton, standard_errors
from r2s.estimation.compiled import Derive, Predicted, derivatives_at, normal_from, normals_at
from r2s.estimation.gauss_newton import Descent, Problems
from r2s.estimation.method import Budget
from r2s.estimation.problem import Problem, beginning

ROUGH = 3.0  # standard errors, by which places around an end lead apart
FIRST, FAR_APART = 2, 2.0  # pairs of them, and times that, where no more are needed

_weight = eqx.filter_jit(gauss_newton.prior_weight)
_covariance = eqx.filter_jit(standard_errors.covariance)
_disagreement = eqx.filter_jit(standard_errors.disagreement)
_tells = eqx.filter_jit(standard_errors.tells)
_steps_apart = eqx.filter_jit(standard_errors.steps_apart)
_sample_around = eqx.filter_jit(standard_errors.sample_around)


def covariance_at(
    problems: Problems,
    budget: Budget,
    end: Descent,
    key: PRNGKeyArray,
    predicted: Predicted | None = None,
    is_truth: bool = False,
    tried_on: Problems | None = None,
    derive: Derive = derivatives_at,
) -> Float[np.ndarray, "theta theta"]:
    """Covariance of theta at the end of a descent, see `r2s.estimation.standard_errors`.

    It comes from as many of the frames as agree. Where Gauss-Newton steps from places around the
    end lead apart, the end of the motion depends on the fabric so steeply that its derivatives say
    nothing; then the budget's shares of the frames are tried, the largest first. If these do not
    agree either, the covariance is that of all frames. A beginning that says nothing of the fabric,
    since nothing has moved yet, agrees with everything, and does not count. Beside other motions
    pulls keep all their frames: their sheets are taut.

    - `predicted`: `derivatives_at` the end, where they are known.
    - `tried_on`: the same recordings on a mesh on which the places around the end are tried: one
      standard error of that mesh away, in which their agreement is told, too.
    - `derive`: what gives derivatives at the end, of which it may know some.
    """
    if predicted is None:
        predicted = derive(problems, end.theta, budget.width)
    tried = _Place(problems, end, predicted)
    if tried_on is not None and tried_on is not problems:
        there = derive(tried_on, end.theta, budget.width)
        tried = _Place(tried_on, _end_in(tried_on, end, there), there)
    found = []
    for share in (1.0, *reversed(budget.shares)):
        seen, here = _beginning(problems, end, share, predicted)
        prior = _weight(problems, here.normal)
        apart, agrees = _around(*_beginning(*tried[:2], share, tried.predicted), budget, key)
        found.append(np.asarray(_covariance(seen, here, prior, apart, is_truth)))
        if agrees and (share == 1 or bool(_tells(problems, here, prior))):
            return found[-1]
    return found[0]


def _beginning(
    problems: Problems, end: Descent, share: float, predicted: Predicted
) -> tuple[Problems, Descent]:
    """The problems up to a share of their frames, and a descent's end in these."""
    if share == 1:
        return problems, end
    seen = cut(problems, share)
    return seen, _end_in(seen, end, predicted)


def cut(problems: Problems, share: float) -> Problems:
    """The beginnings of those that may move too steeply: of all, or of all but the pulls, and these
    then count by the frames that are left, too."""
    if len({problem.is_pulled for problem in problems}) == 1:
        return tuple(beginning(each, share) for each in problems)
    return tuple(each if each.is_pulled else _lighter(each, share) for each in problems)


def _lighter(problem: Problem, share: float) -> Problem:
    weight = jnp.ones((), float) if problem.weight is None else problem.weight
    return dataclasses.replace(beginning(problem, share), weight=share * weight)


def _end_in(problems: Problems, end: Descent, predicted: Predicted) -> Descent:
    """The end of a descent with its normal equations in other problems."""
    normal = normal_from(problems, end.theta, predicted, end.scale)
    return dataclasses.replace(end, normal=normal)


class _Place(NamedTuple):
    """The end of a descent on some mesh, with `derivatives_at` it."""

    problems: Problems
    end: Descent
    predicted: Predicted


def _around(
    problems: Problems, end: Descent, budget: Budget, key: PRNGKeyArray
) -> tuple[Float[Array, "place theta"], bool]:
    """How far steps from places around the end of a descent lead apart, and whether they agree.

    Where the first pairs of opposite places disagree by far, there are no others.
    """
    apart = jnp.zeros((0, len(end.theta)), float)
    if not budget.around:
        return apart, True
    prior = _weight(problems, end.normal)
    places = _sample_around(problems, end, prior, budget.around, key)
    pairs = list(places.reshape(2, -1, places.shape[-1]).swapaxes(0, 1))
    neighbours: standard_errors.Neighbours = []
    for some in (pairs[:FIRST], pairs[FIRST:]):
        thetas = [theta for pair in some for theta in pair]
        if not thetas:
            continue
        normals = normals_at(problems, thetas, [end.scale] * len(thetas), budget.width)
        neighbours += zip(thetas, normals, strict=True)
        is_last = len(neighbours) == budget.around
        apart = _steps_apart(problems, end, prior, neighbours)
        far = float(_disagreement(problems, end, prior, apart))
        if not far < (ROUGH if is_last else FAR_APART * ROUGH):
            return apart, False
    return apart, True
