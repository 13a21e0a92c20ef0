"""Whether recordings are consistent with each other, and each with the estimate.

`agreement`: from the estimate, a descent in each recording alone. Its information beyond the prior
is compared with that of the others; more scatter than standard errors allow means another fabric in
one of them, or an error in what was written down of it. (The covariance at the estimate would not
show that: a misfit there counts as noise.) A sheet taken to be ten times as heavy needs ten times
the stiffness to hang as recorded, and pulls far harder than its load cell showed: where
`asks_for_density` says so, a descent `with_free_density` finds which density would fit.

`misfits` and `fits`: nothing that was recorded is left out silently.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special, stats

from r2s.estimation.estimate import UNLIKELY, Agreement, Contradiction, Fit, Misfit
from r2s.estimation.gauss_newton import Descent, held_back, prior_weight
from r2s.estimation.least_squares import common_axes
from r2s.estimation.normal_equations import marker_distances, point_distances
from r2s.estimation.prediction import Prediction, Theta, free_nuisances
from r2s.estimation.problem import Problem, Problems
from r2s.estimation.standard_errors import sandwich_of
from r2s.metrics.losses import robust_weight

# of a range, by which the error of a mesh is allowed for at most, since one step may say far more.
# Lifts on 17 x 17 vertices err in warp, weft and shear by 0.10, root mean square (version 0.3.0);
# with that, a density ten times off is doubted less often.
MOST = 0.08
# what moves with the density, where no force is measured
SCALED = ("warp", "weft", "shear", "bending", "E h")
LOOSE = math.log(30.0)  # standard deviation of the logarithm of a wrong density
MORE, SOME = 2.0, 1 + 1e-6  # times a prior's precision: more informative, and at all
RCOND = 1e-9  # of the recordings' information together: less than that is none
STRAY, FEWEST = 5.0, 4  # times the other markers' distance; markers that are needed to say so
LEAST = 2e-3  # [m], nearer than which no marker is on another cloth: ten times what trackers err
LATE = 1 / 3  # of the frames, the last ones, in which a marker that was lost on the way strays
BENT = 3.0  # prior standard deviations
FORCE, FAR_OFF = "force", 1 / 3  # of its size, root mean square: beyond is another sheet's
LITTLE = 0.25  # weight below which something is an outlier: that of what lies beyond the scale


class Information(NamedTuple):
    """What a recording says of the fabric's place in the unit cube, without the prior.

    - `place`; `information`: its precision, zero in directions better known by the prior.
    - `count`: of the other directions.
    """

    place: Float[np.ndarray, " dim"]
    information: Float[np.ndarray, "dim dim"]
    count: int


def agreement(
    problems: Problems,
    ends: Sequence[Descent],
    biases: Sequence[Float[np.ndarray, " theta"]] = (),
) -> Agreement | None:
    """Whether some recordings agree; None where no two of them determine the same.

    - `ends`: of a descent in each recording alone.
    - `biases`: of each end by its mesh, if estimated. One step says how far, not in which
      direction: each parameter is allowed for by itself, by `MOST` at most.

    The weighted scatter about the mean has a chi-squared distribution. The recording is named whose
    contribution is least likely, see `outlier`.
    """
    if len(problems) < 2:
        return None
    space = problems[0].space
    dim = space.dim
    mean, precision = (np.asarray(part, np.float64) for part in space.prior())
    ended = [_end(problem, end, dim) for problem, end in zip(problems, ends, strict=True)]
    if not all(np.isfinite(part).all() for pair in ended for part in pair):
        return None
    errors = [np.minimum(np.abs(bias[:dim]), MOST) for bias in biases] or [np.zeros(dim)] * len(
        ends
    )
    allowed = [
        (place, covariance + np.diag(error**2))
        for (place, covariance), error in zip(ended, errors, strict=True)
    ]
    known = [information_of(*each, mean, precision) for each in allowed]
    if not scatter_of(known)[1]:
        return None
    exact = p_value([information_of(*each, mean, precision) for each in ended]) if biases else None
    density, pulled = None, [problem.is_pulled for problem in problems]
    if any(pulled) and not all(pulled):
        scaled = np.array([(r.name in SCALED) / r.width for r in space.ranges])
        every = [information_of(*each, mean, precision, least=SOME) for each in allowed]
        density = density_of(every, pulled, scaled, mean, precision)
    p, counts = p_value(known), tuple(each.count for each in known)
    if not p < UNLIKELY:
        return Agreement(p, counts, None, density, exact)
    odd = outlier(known)
    rest = [each for i, each in enumerate(known) if i != odd]
    (here, own), (there, others) = (
        _posterior(each, mean, precision) for each in ([known[odd]], rest)
    )
    apart = np.abs(here - there) / np.sqrt(np.diag(own) + np.diag(others))
    most = int(np.argmax(apart))
    of = space.ranges[most]
    first, second = (float(of.from_unit(jnp.asarray(at[most], float))) for at in (here, there))
    found = Contradiction(odd, of.name, float(apart[most]), (first, second))
    return Agreement(p, counts, found, density, exact)


def information_of(
    place: Float[np.ndarray, " dim"],
    covariance: Float[np.ndarray, "dim dim"],
    mean: Float[np.ndarray, " dim"],
    precision: Float[np.ndarray, "dim dim"],
    least: float = MORE,
) -> Information:
    """The information of an estimate without its prior of a `mean` and a `precision`, in directions
    that it knows `least` times as precisely."""
    sizes, axes = common_axes(precision, np.linalg.inv(covariance))
    kept = sizes > least
    beyond = np.where(kept, sizes - 1, 1)
    at, usual = axes.T @ place, axes.T @ mean
    alone = np.where(kept, (sizes * at - usual) / beyond, usual)
    information = (axes * np.where(kept, beyond, 0)[None]) @ axes.T
    return Information(np.linalg.solve(axes.T, alone), information, int(kept.sum()))


def density_of(
    known: Sequence[Information],
    pulled: Sequence[bool],
    scaled: Float[np.ndarray, " dim"],
    mean: Float[np.ndarray, " dim"],
    precision: Float[np.ndarray, "dim dim"],
) -> tuple[float, float]:
    """The density with which recordings would agree best, relative to the given one, [-], and the
    standard error of its logarithm: by least squares, beside a prior of the fabric.

    - `pulled`: which of them measure a force. In the others ten times the density moves like ten
      times all stiffness, whose places it moves along `scaled`, per unit of its logarithm. (Nor
      does a wind measure it: its own force is in doubt.)
    """
    dim = len(mean)
    matrix, right = np.zeros((dim + 1, dim + 1)), np.zeros(dim + 1)
    matrix[:dim, :dim], right[:dim] = precision, precision @ mean
    matrix[dim, dim] = 1 / LOOSE**2
    for each, is_pulled in zip(known, pulled, strict=True):
        moves = np.column_stack([np.eye(dim), np.zeros(dim) if is_pulled else scaled])
        matrix += moves.T @ each.information @ moves
        right += moves.T @ each.information @ each.place
    covariance = np.linalg.inv(matrix)
    given_too_high = (covariance @ right)[dim]
    return float(np.exp(-given_too_high)), float(np.sqrt(covariance[dim, dim]))


def asks_for_density(
    problems: Problems, found: Agreement | None, misfits: Sequence[Misfit]
) -> bool:
    """Whether some of several recordings measure a force, and they or it do not fit."""
    if len(problems) < 2 or not any(problem.is_pulled for problem in problems):
        return False
    is_apart = found is not None and (found.contradiction is not None or found.doubts_density)
    return is_apart or any(each.what == FORCE for each in misfits)


def with_free_density(problems: Problems, theta: Theta) -> tuple[Problems, Theta]:
    """The problems with a density of which only the order is known, and a theta in its units."""
    place, given = problems[0].space.dim, problems[0].nuisance_prior.density
    loose = tuple(
        dataclasses.replace(p, nuisance_prior=p.nuisance_prior._replace(density=LOOSE))
        for p in problems
    )
    return loose, theta.at[place].multiply(given / LOOSE)


def with_density(found: Agreement | None, loose: Problems, end: Descent) -> Agreement | None:
    """An agreement with the density at the end of a descent in problems of `with_free_density`.
    None stays None where that density is not doubted."""
    place = loose[0].space.dim
    covariance, _ = sandwich_of(loose, end, prior_weight(loose, end.normal))
    error = LOOSE * float(np.sqrt(covariance[place, place]))
    density = float(np.exp(LOOSE * float(end.theta[place]))), error
    judged = (found or Agreement(1.0, (0,) * len(loose), None))._replace(density=density)
    return judged if found or judged.doubts_density else None


def scatter_of(known: Sequence[Information]) -> tuple[float, int]:
    """Squared distances from the weighted mean, in standard errors, and the degrees of freedom."""
    total = np.sum([each.information for each in known], axis=0)
    led = np.sum([each.information @ each.place for each in known], axis=0)
    mean = np.linalg.pinv(total, rcond=RCOND, hermitian=True) @ led
    off = [(each.place - mean, each.information) for each in known]
    scatter = sum(float(away @ information @ away) for away, information in off)
    shared = np.linalg.matrix_rank(total, tol=RCOND * np.linalg.norm(total, 2), hermitian=True)
    return scatter, int(sum(each.count for each in known) - shared)


def p_value(known: Sequence[Information]) -> float:
    """Probability of as much scatter between recordings of one fabric, [-]; 1 without degrees of
    freedom."""
    scatter, freedom = scatter_of(known)
    return float(stats.chi2.sf(scatter, freedom)) if freedom else 1.0


def outlier(known: Sequence[Information]) -> int:
    """The index of the recording whose contribution to the scatter is least likely for the degrees
    of freedom that it adds. Of several alike, the last: of two, the second."""
    scatter, freedom = scatter_of(known)

    def likely(which: int) -> tuple[float, int]:
        less, left = scatter_of([each for i, each in enumerate(known) if i != which])
        if left == freedom:  # it shares nothing with the others
            return 0.0, -which
        return round(_log_p_value(scatter - less, freedom - left), 6), -which

    return min(range(len(known)), key=likely)


def _log_p_value(scatter: float, freedom: int) -> float:
    """The logarithm of the tail of chi squared; where that underflows, by the first term of its
    series."""
    found = float(stats.chi2.logsf(scatter, freedom))
    if np.isfinite(found):
        return found
    half = freedom / 2
    return float((half - 1) * np.log(scatter / 2) - scatter / 2 - special.gammaln(half))


def _posterior(known: Sequence[Information], mean, precision) -> tuple[np.ndarray, np.ndarray]:
    """Place and covariance by some recordings and the prior."""
    covariance = np.linalg.inv(precision + np.sum([each.information for each in known], axis=0))
    led = precision @ mean + np.sum([each.information @ each.place for each in known], axis=0)
    return covariance @ led, covariance


def _end(problem: Problem, end: Descent, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a recording leads with the prior, and its covariance there. How far it would go without
    bounds is an error of its place: no bound is information."""
    prior = prior_weight((problem,), end.normal)
    covariance, _ = sandwich_of((problem,), end, prior)
    back = held_back((problem,), end, float(prior))[:dim]
    known = np.asarray(covariance, np.float64)[:dim, :dim] + np.outer(back, back)
    return np.asarray(end.theta, np.float64)[:dim], known


def misfits(
    problems: Problems, theta: Float[Array, " theta"], predicted: Sequence[Prediction]
) -> tuple[Misfit, ...]:
    """The markers that stray, the forces that are missed and the nuisance parameters far from their
    prior, of all recordings.

    - `predicted`: of each recording at `theta`, the end of an estimate.

    A marker strays when the median of its distances, over all frames or over the last third, is
    `STRAY` times that of the median marker and at least `LEAST`; of fewer than `FEWEST` nothing is
    said. A force is missed when it differs by `FAR_OFF` of its size.
    """
    pairs = list(enumerate(zip(problems, predicted, strict=True)))
    found = [stray for which, pair in pairs for stray in _strays(which, *pair)]
    found += [missed for which, pair in pairs for missed in _missed(which, *pair)]
    for each in free_nuisances(problems):
        off = abs(float(theta[each.place]))
        if off > BENT:
            found.append(Misfit(each.recording, each.name, off, "standard deviations"))
    return tuple(found)


def fits(problems: Problems, predicted: Sequence[Prediction], scale: float) -> tuple[Fit, ...]:
    """How far each recording's points or markers are from its prediction, and the share of them
    that lies beyond the `scale` [m] of the loss (`r2s.metrics.losses.robust`)."""
    found = []
    for problem, seen in zip(problems, predicted, strict=True):
        distance, mask = marker_distances(problem, seen) or point_distances(problem, seen, scale)
        known = np.asarray(mask)
        is_out = np.asarray(robust_weight(distance, scale) < LITTLE)[known]
        near = np.asarray(distance)[known][~is_out]
        mean = float(np.mean(near)) if near.size else np.nan
        found.append(Fit("", mean, float(is_out.mean()) if is_out.size else 0.0))
    return tuple(found)


def _strays(which: int, problem: Problem, seen: Prediction) -> list[Misfit]:
    pair = marker_distances(problem, seen)
    if pair is None:
        return []
    distance = np.where(np.asarray(pair[1]), np.asarray(pair[0], np.float64), np.nan)
    late = distance[round((1 - LATE) * len(distance)) :]
    strays: dict[int, float] = {}
    for frames in (distance, late):
        known = np.flatnonzero(~np.isnan(frames).all(axis=0))
        if len(known) < FEWEST:
            continue
        typical = np.nanmedian(frames[:, known], axis=0)
        limit = max(STRAY * float(np.median(typical)), LEAST)
        for marker, away in zip(known.tolist(), typical.tolist(), strict=True):
            if away > limit:
                strays[marker] = max(away, strays.get(marker, 0.0))
    return [Misfit(which, f"marker {each}", away, "m") for each, away in sorted(strays.items())]


def _missed(which: int, problem: Problem, seen: Prediction) -> list[Misfit]:
    if problem.force is None or seen.force is None:
        return []
    is_seen = np.asarray(problem.force.seen)
    recorded, simulated = (
        np.asarray(each, np.float64)[is_seen] for each in (problem.force.values, seen.force)
    )
    size = np.sqrt(np.mean(recorded**2))
    off = float(np.sqrt(np.mean((simulated - recorded) ** 2)) / size) if size > 0 else 0.0
    return [Misfit(which, FORCE, off, "of its size")] if off > FAR_OFF else []
