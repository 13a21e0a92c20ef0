"""Whether recordings are consistent with each other, and each with the estimate.

`agreement`: the end of each recording alone is that by the derivative at the estimate
(`by_slopes`); where by these they seem to differ, that of a descent. Its information beyond the
prior is compared with that of the others: more scatter than standard errors allow means another
fabric in one of them, or an error of its recorded conditions. (The covariance at the estimate would
not show that: a misfit there counts as noise.) With a density ten times too large the stiffness
must be ten times as large for the sheet to hang as recorded, and pulls far harder than the load
cell measured: where `asks_for_density` says so, `with_density` estimates it.

`misfits` and `fits`: no observation is left out silently.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special, stats

from r2s.estimation.descent import Diverged, Run, multi_start
from r2s.estimation.estimate import UNLIKELY, Agreement, Contradiction, Fit, Misfit
from r2s.estimation.gauss_newton import (
    Descent,
    held_back,
    normal_from,
    prior_weight,
    propose,
)
from r2s.estimation.least_squares import common_axes
from r2s.estimation.normal_equations import marker_distances, point_distances
from r2s.estimation.prediction import (
    Predicted,
    Prediction,
    Theta,
    free_nuisances,
    in_proportion,
    remembering,
)
from r2s.estimation.problem import Problem, Problems
from r2s.estimation.standard_errors import sandwich_of
from r2s.metrics.losses import robust_weight

# of a range: the largest error of a mesh that is allowed for, since one step may be far too long.
# Lifts on 17 x 17 vertices err in warp, weft and shear by 0.10, root mean square (version 0.3.0);
# with that, a density ten times off is doubted less often.
MOST = 0.08
STEPS, SURE = 4, 0.05  # of `by_slopes`; p-value by these from which on no descents are needed
# parameters in proportion to the density, where no force is measured
SCALED = ("warp", "weft", "shear", "bending", "E h")
LOOSE = math.log(30.0)  # standard deviation of the logarithm of a wrong density
MORE, SOME = 2.0, 1 + 1e-6  # times a prior's precision: more informative, and at all
RCOND = 1e-9  # of the recordings' information together: less than that is none
STRAY, FEWEST = 5.0, 4  # times the other markers' distance; markers that are needed to say so
LEAST = 2e-3  # [m], nearer than which no marker is on another cloth: ten times a tracker's error
LATE = 1 / 3  # of the frames, the last ones, in which a marker that the tracker lost strays
BENT = 3.0  # prior standard deviations
FORCE, FAR_OFF = "force", 1 / 3  # of its size, root mean square: beyond is another sheet's
LITTLE = 0.25  # weight of a residual beyond the scale: below, it is an outlier

Vector = Float[np.ndarray, " dim"]
Matrix = Float[np.ndarray, "dim dim"]


def by_slopes(problem: Problem, theta: Theta, predicted: Predicted, scale: Array) -> Descent:
    """The end of a descent in a recording alone, did its motion change in proportion to theta.

    - `predicted`: at `theta`, with its derivative. `scale`: of the robust loss, [m].
    """
    only, zero = (problem,), jnp.zeros((), float)

    def at(place: Theta) -> Descent:
        normal = normal_from(only, place, [in_proportion(predicted[0], place - theta)], scale)
        return Descent(place, normal, zero, zero, jnp.asarray(scale, float), zero.astype(int))

    end = at(theta)
    for _ in range(STEPS):
        end = at(propose(only, end, prior_weight(only, end.normal)))  # without damping
    return end


class Information(NamedTuple):
    """The information of a recording on the fabric's place in the unit cube, without the prior.

    - `place`; `information`: its precision, zero in directions better known by the prior.
    - `count`: of the other directions.
    """

    place: Vector
    information: Matrix
    count: int


def agreement(
    problems: Problems, ends: Sequence[Descent], biases: Sequence[Vector] = ()
) -> Agreement | None:
    """Whether some recordings agree; None where no two of them determine the same.

    - `ends`: of a descent in each recording alone.
    - `biases`: of each end by its mesh, if estimated. Their size is known better than their
      direction: each parameter is allowed for by itself, by `MOST` at most.

    The weighted scatter about the mean has a chi-squared distribution. The recording is named whose
    contribution is least likely, see `outlier`.
    """
    if len(problems) < 2:
        return None
    space = problems[0].space
    dim = space.dim
    mean, precision = (np.asarray(part, np.float64) for part in space.prior())
    prior = mean, precision
    exact = [_end(problem, end, dim) for problem, end in zip(problems, ends, strict=True)]
    if not all(np.isfinite(part).all() for pair in exact for part in pair):
        return None
    errors = [
        np.minimum(np.abs(bias[:dim]), MOST) for bias in biases or [np.zeros(dim)] * len(ends)
    ]
    allowed = [
        (place, covariance + np.diag(error**2))
        for (place, covariance), error in zip(exact, errors, strict=True)
    ]
    known = [information_of(*end, *prior) for end in allowed]
    if not scatter_of(known)[1]:
        return None
    density, pulled = None, [problem.is_pulled for problem in problems]
    if any(pulled) and not all(pulled):
        scaled = np.array([(r.name in SCALED) / r.width for r in space.ranges])
        every = [information_of(*end, *prior, least=SOME) for end in allowed]
        density = density_of(every, pulled, scaled, *prior)
    agreed = Agreement(p_value(known), tuple(part.count for part in known), None, density)
    if biases:
        p = p_value([information_of(*end, *prior) for end in exact])
        agreed = agreed._replace(exact=p)
    if not agreed.p < UNLIKELY:
        return agreed
    odd = outlier(known)
    rest = [part for i, part in enumerate(known) if i != odd]
    own, others = (_posterior(parts, *prior) for parts in ([known[odd]], rest))
    apart = np.abs(own[0] - others[0]) / np.sqrt(np.diag(own[1]) + np.diag(others[1]))
    most = int(np.argmax(apart))
    bound = space.ranges[most]
    first, second = (
        float(bound.from_unit(jnp.asarray(place[most], float))) for place, _ in (own, others)
    )
    named = Contradiction(odd, bound.name, float(apart[most]), (first, second))
    return agreed._replace(contradiction=named)


def is_sure(agreed: Agreement) -> bool:
    """Whether recordings agree so well `by_slopes` that no descents are needed."""
    return agreed.p >= SURE and not agreed.doubts_density


def information_of(
    place: Vector, covariance: Matrix, mean: Vector, precision: Matrix, least: float = MORE
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
    scaled: Vector,
    mean: Vector,
    precision: Matrix,
) -> tuple[float, float]:
    """The density with which recordings would agree best, relative to the given one, [-], and the
    standard error of its logarithm: by least squares, beside a prior of the fabric.

    - `pulled`: which of them measure a force. Ten times the density has the same effect on the
      others as a tenth of all stiffness, whose places it moves along `scaled`, per unit of its
      logarithm. (Nor does a wind measure it: its own force is uncertain.)
    """
    dim = len(mean)
    matrix, right = np.zeros((dim + 1, dim + 1)), np.zeros(dim + 1)
    matrix[:dim, :dim], right[:dim] = precision, precision @ mean
    matrix[dim, dim] = 1 / LOOSE**2
    for part, is_pulled in zip(known, pulled, strict=True):
        moves = np.column_stack([np.eye(dim), np.zeros(dim) if is_pulled else scaled])
        matrix += moves.T @ part.information @ moves
        right += moves.T @ part.information @ part.place
    covariance = np.linalg.inv(matrix)
    given_too_high = (covariance @ right)[dim]
    return float(np.exp(-given_too_high)), float(np.sqrt(covariance[dim, dim]))


def asks_for_density(
    problems: Problems, agreed: Agreement | None, misfits: Sequence[Misfit]
) -> bool:
    """Whether some of several recordings measure a force, and they or it do not fit."""
    if len(problems) < 2 or not any(problem.is_pulled for problem in problems):
        return False
    is_apart = agreed is not None and (agreed.contradiction is not None or agreed.doubts_density)
    return is_apart or any(misfit.what == FORCE for misfit in misfits)


def with_density(
    agreed: Agreement | None, problems: Problems, run: Run, theta: Theta
) -> Agreement | None:
    """An agreement with the density that fits all recordings, by a descent from `theta` with only
    the order of the density known. As it was where that diverges, and None where there is none and
    the given density is not doubted."""
    place, given = problems[0].space.dim, problems[0].nuisance_prior.density
    loose = tuple(
        dataclasses.replace(p, nuisance_prior=p.nuisance_prior._replace(density=LOOSE))
        for p in problems
    )
    run = run.near(is_intermediate=False).beside(".density.npz")._replace(derive=remembering())
    start = theta.at[place].multiply(given / LOOSE)
    try:
        end = multi_start(loose, run, start=start, words="which density would fit").best
    except Diverged:
        return agreed
    covariance, _ = sandwich_of(loose, end, prior_weight(loose, end.normal))
    error = LOOSE * float(np.sqrt(covariance[place, place]))
    density = float(np.exp(LOOSE * float(end.theta[place]))), error
    judged = (agreed or Agreement(1.0, (0,) * len(loose), None))._replace(density=density)
    return judged if agreed or judged.doubts_density else None


def _summed(known: Sequence[Information]) -> tuple[Matrix, Vector]:
    """The information of some recordings, and that times their places."""
    total = np.sum([part.information for part in known], axis=0)
    return total, np.sum([part.information @ part.place for part in known], axis=0)


def scatter_of(known: Sequence[Information]) -> tuple[float, int]:
    """Squared distances from the weighted mean, in standard errors, and the degrees of freedom."""
    total, right = _summed(known)
    mean = np.linalg.pinv(total, rcond=RCOND, hermitian=True) @ right
    off = [(part.place - mean, part.information) for part in known]
    scatter = sum(float(away @ information @ away) for away, information in off)
    shared = np.linalg.matrix_rank(total, tol=RCOND * np.linalg.norm(total, 2), hermitian=True)
    return scatter, int(sum(part.count for part in known) - shared)


def p_value(known: Sequence[Information]) -> float:
    """Probability of as much scatter between recordings of one fabric, [-]; 1 without degrees of
    freedom."""
    scatter, freedom = scatter_of(known)
    return float(stats.chi2.sf(scatter, freedom)) if freedom else 1.0


def outlier(known: Sequence[Information]) -> int:
    """The index of the recording whose contribution to the scatter is least likely for the degrees
    of freedom that it adds. Of several, the last: of two, the second."""
    scatter, freedom = scatter_of(known)

    def likely(which: int) -> tuple[float, int]:
        less, left = scatter_of([part for i, part in enumerate(known) if i != which])
        if left == freedom:  # it shares nothing with the others
            return 0.0, -which
        return round(_log_p_value(scatter - less, freedom - left), 6), -which

    return min(range(len(known)), key=likely)


def _log_p_value(scatter: float, freedom: int) -> float:
    """The logarithm of the tail of chi squared; where that underflows, the first term of its
    series."""
    log_tail = float(stats.chi2.logsf(scatter, freedom))
    if np.isfinite(log_tail):
        return log_tail
    half = freedom / 2
    return float((half - 1) * np.log(scatter / 2) - scatter / 2 - special.gammaln(half))


def _posterior(
    known: Sequence[Information], mean: Vector, precision: Matrix
) -> tuple[Vector, Matrix]:
    """Place and covariance by some recordings and the prior."""
    total, right = _summed(known)
    covariance = np.linalg.inv(precision + total)
    return covariance @ (precision @ mean + right), covariance


def _end(problem: Problem, end: Descent, dim: int) -> tuple[Vector, Matrix]:
    """Place and covariance by a recording and the prior. How far it would move without bounds is an
    error of its place: no bound is information."""
    prior = prior_weight((problem,), end.normal)
    covariance, _ = sandwich_of((problem,), end, prior)
    back = held_back((problem,), end, float(prior))[:dim]
    whole = np.asarray(covariance, np.float64)[:dim, :dim] + np.outer(back, back)
    return np.asarray(end.theta, np.float64)[:dim], whole


def misfits(
    problems: Problems, theta: Float[Array, " theta"], predictions: Sequence[Prediction]
) -> tuple[Misfit, ...]:
    """The markers that stray, the forces that are missed and the nuisance parameters far from their
    prior, of all recordings; `predictions`: of each at `theta`, the end of an estimate.

    A marker strays when the median of its distances, over all frames or over the last third, is
    `STRAY` times that of the median marker and at least `LEAST`, among `FEWEST` markers or more. A
    force is missed when it differs by `FAR_OFF` of its size.
    """
    pairs = list(enumerate(zip(problems, predictions, strict=True)))
    strays = [misfit for which, pair in pairs for misfit in _strays(which, *pair)]
    missed = [misfit for which, pair in pairs for misfit in _missed(which, *pair)]
    bent = [
        Misfit(nuisance.recording, nuisance.name, off, "standard deviations")
        for nuisance in free_nuisances(problems)
        if (off := abs(float(theta[nuisance.place]))) > BENT
    ]
    return (*strays, *missed, *bent)


def fits(problems: Problems, predictions: Sequence[Prediction], scale: float) -> tuple[Fit, ...]:
    """Distance of each recording's points or markers from its prediction, and the share of them
    that lies beyond the `scale` [m] of the loss (`r2s.metrics.losses.robust`)."""
    rows = []
    for problem, prediction in zip(problems, predictions, strict=True):
        markers = marker_distances(problem, prediction)
        distance, mask = markers or point_distances(problem, prediction, scale)
        known = np.asarray(mask)
        is_out = np.asarray(robust_weight(distance, scale) < LITTLE)[known]
        near = np.asarray(distance)[known][~is_out]
        mean = float(np.mean(near)) if near.size else np.nan
        rows.append(Fit("", mean, float(is_out.mean()) if is_out.size else 0.0))
    return tuple(rows)


def _strays(which: int, problem: Problem, prediction: Prediction) -> list[Misfit]:
    pair = marker_distances(problem, prediction)
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
    return [Misfit(which, f"marker {number}", away, "m") for number, away in sorted(strays.items())]


def _missed(which: int, problem: Problem, prediction: Prediction) -> Iterator[Misfit]:
    if problem.force is None or prediction.force is None:
        return
    is_seen = np.asarray(problem.force.seen)
    recorded, simulated = (
        np.asarray(force, np.float64)[is_seen] for force in (problem.force.values, prediction.force)
    )
    size = np.sqrt(np.mean(recorded**2))
    off = float(np.sqrt(np.mean((simulated - recorded) ** 2)) / size) if size > 0 else 0.0
    if off > FAR_OFF:
        yield Misfit(which, FORCE, off, "of its size")
