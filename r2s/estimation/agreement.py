"""Do the recordings of an estimate tell of one fabric?

From the estimate, each recording alone is descended to where it would lead. Where one leads many
standard errors away from the others they contradict each other: another fabric in one of them, or
an error in what was written down of it. (The covariance at the estimate itself would not show
that: what a recording misfits there counts as its noise.)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from r2s.estimation import standard_errors
from r2s.estimation.estimate import Contradiction
from r2s.estimation.gauss_newton import Descent, Problems, prior_weight

UNLIKELY = 1e-3  # that recordings of one fabric lead so far apart by chance


class Led(NamedTuple):
    """Where a recording leads in the fabric's space, in the unit cube, and how well it is known."""

    place: Float[np.ndarray, " dim"]
    covariance: Float[np.ndarray, "dim dim"]


def contradiction(
    problems: Problems,
    ends: Sequence[Descent],
    biases: Sequence[Float[np.ndarray, " theta"]] = (),
) -> Contradiction | None:
    """The recording that contradicts the others the most, where one does.

    - `ends`: of a descent in each recording alone.
    - `biases`: of each end by its mesh; none where that was not judged. A lift that buckles
      elsewhere on a finer mesh leads far astray, pulls hardly. How far is told by one step, in
      which direction is not: each parameter is excused by itself.

    Their weighted scatter around their mean, over the fabric's parameters with nuisances free, is
    compared with its chi-squared distribution. The one is named without which the others agree
    best; of two, the second. Of one recording there is nothing to say.
    """
    if len(problems) < 2:
        return None
    dim = problems[0].space.dim
    excused = [bias[:dim] for bias in biases] or [np.zeros(dim)] * len(problems)
    rows = zip(problems, ends, excused, strict=True)
    led = [_led((problem,), end, by) for problem, end, by in rows]
    if not all(np.isfinite(part).all() for one in led for part in one):
        return None  # nothing is known
    p = float(stats.chi2.sf(_scatter(led), dim * (len(led) - 1)))
    if not p < UNLIKELY:
        return None
    which = min(range(len(led)), key=lambda odd: _scatter(_without(led, odd)))
    which = 1 if len(led) == 2 else which
    errors = _apart(led[which], _mean(_without(led, which)))
    most = int(np.argmax(errors))
    return Contradiction(which, p, problems[0].space.ranges[most].name, float(errors[most]))


def _without(led: list[Led], odd: int) -> list[Led]:
    return [one for i, one in enumerate(led) if i != odd]


def _mean(led: list[Led]) -> Led:
    """The mean, weighed by precisions."""
    precisions = [np.linalg.inv(one.covariance) for one in led]
    covariance = np.linalg.inv(np.sum(precisions, axis=0))
    pairs = zip(precisions, led, strict=True)
    return Led(covariance @ np.sum([p @ one.place for p, one in pairs], axis=0), covariance)


def _scatter(led: list[Led]) -> float:
    """Squared distances from the mean, in standard errors."""
    mean = _mean(led).place
    off = [(one.place - mean, one.covariance) for one in led]
    return float(sum(away @ np.linalg.solve(covariance, away) for away, covariance in off))


def _apart(one: Led, other: Led) -> Float[np.ndarray, " dim"]:
    """Of every parameter, by how many standard errors two differ."""
    variance = np.diag(one.covariance) + np.diag(other.covariance)
    return np.abs(one.place - other.place) / np.sqrt(variance)


def _led(problems: Problems, end: Descent, excused: Float[np.ndarray, " dim"]) -> Led:
    dim = problems[0].space.dim
    prior = prior_weight(problems, end.normal)
    covariance, _ = standard_errors.sandwich_of(problems, end, prior)
    own = np.asarray(covariance, float)[:dim, :dim]
    return Led(np.asarray(end.theta, float)[:dim], own + np.diag(excused**2))
