"""The covariance of an estimate, from as many frames of its recordings as agree."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from r2s.estimation import gauss_newton, standard_errors
from r2s.estimation.compiled import Predicted, derivatives_at, normal_from, normals_at
from r2s.estimation.gauss_newton import Descent, Problems
from r2s.estimation.method import Budget
from r2s.estimation.problem import beginning

ROUGH = 3.0  # standard errors, by which places around an end lead apart
FIRST, FAR_APART = 2, 2.0  # pairs of them, and times that, where no more are needed

_weight = eqx.filter_jit(gauss_newton.prior_weight)
_covariance = eqx.filter_jit(standard_errors.covariance)
_disagreement = eqx.filter_jit(standard_errors.disagreement)
_tells = eqx.filter_jit(standard_errors.tells)
_sample_around = eqx.filter_jit(standard_errors.sample_around)


def covariance_at(
    problems: Problems,
    budget: Budget,
    end: Descent,
    key: PRNGKeyArray,
    predicted: Predicted | None = None,
    is_truth: bool = False,
) -> Float[np.ndarray, "theta theta"]:
    """Covariance of theta at the end of a descent, see `r2s.estimation.standard_errors`.

    It comes from as many of the frames as agree. Where Gauss-Newton steps from places around the
    end lead apart, the end of the motion depends on the fabric so steeply that its derivatives say
    nothing; then the budget's shares of the frames are tried, the largest first. If these do not
    agree either, the covariance is that of all frames. A beginning that says nothing of the fabric,
    since nothing has moved yet, agrees with everything, and does not count.

    `predicted`: `derivatives_at` the end, where they are known.
    """
    if predicted is None:
        predicted = derivatives_at(problems, end.theta, budget.width)
    found = []
    for share in (1.0, *reversed(budget.shares)):
        seen, here = problems, end
        if share < 1:
            seen = tuple(beginning(problem, share) for problem in problems)
            normal = normal_from(seen, end.theta, predicted, end.scale)
            here = dataclasses.replace(end, normal=normal)
        prior = _weight(problems, here.normal)
        neighbours, agrees = _around(seen, budget, here, prior, key)
        found.append(np.asarray(_covariance(problems, here, prior, neighbours, is_truth)))
        if agrees and (share == 1 or bool(_tells(problems, here, prior))):
            return found[-1]
    return found[0]


def _around(
    problems: Problems, budget: Budget, end: Descent, prior, key
) -> tuple[standard_errors.Neighbours, bool]:
    """The normal equations at places around the end of a descent, and whether they agree.

    Where the first pairs of opposite places disagree by far, there are no others.
    """
    if not budget.around:
        return [], True
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
        apart = float(_disagreement(problems, end, prior, neighbours))
        if not apart < (ROUGH if is_last else FAR_APART * ROUGH):
            return neighbours, False
    return neighbours, True
