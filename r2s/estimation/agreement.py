"""Do the recordings of an estimate tell of one fabric?

From the estimate, each recording alone is descended to where it would lead. What the prior says is
taken out again, since all would share it, and so are the directions that a recording tells less of
than the prior. Where the rest scatters by more than standard errors allow, the recordings
contradict each other: another fabric in one of them, or an error in what was written down of it.
(The covariance at the estimate itself would not show that: what a recording misfits there counts as
its noise.)

A sheet that is taken to be ten times as heavy needs ten times the stiffness to hang as it was
recorded, and then pulls far harder than its load cell showed. Where `asks_for_density` says so, a
descent in all recordings `with_free_density` tells which density would fit.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import special, stats

from r2s.estimation import standard_errors
from r2s.estimation.bounded import held_back
from r2s.estimation.estimate import UNLIKELY, Agreement, Contradiction, Misfit
from r2s.estimation.gauss_newton import Descent, Problems, prior_weight
from r2s.estimation.misfits import FORCE
from r2s.estimation.prediction import Theta

# Of a range, by which a mesh excuses a parameter at most, since one step may say far more. Lifts on
# 17 x 17 vertices err in warp, weft and shear by 0.10, root mean square
# (version 0.3.0); with that, a density ten times off is doubted less often.
MOST = 0.08
# what moves with the density, where nothing weighs the sheet
SCALED = ("warp", "weft", "shear", "bending", "E h")
HARDLY = math.log(30.0)  # standard deviation of the logarithm of a density written down wrongly
MORE, SOME = 2.0, 1 + 1e-6  # times a prior's precision: told weighs more, and at all
RCOND = 1e-9  # of the recordings' information together: less than that is none


class Told(NamedTuple):
    """What a recording tells of the fabric's place in the unit cube, without the prior.

    - `place`: where it leads. `information`: how well it is known, a precision; zero in directions
      of which the prior knows more. `count`: of the others.
    """

    place: Float[np.ndarray, " dim"]
    information: Float[np.ndarray, "dim dim"]
    count: int


def agreement(
    problems: Problems,
    ends: Sequence[Descent],
    biases: Sequence[Float[np.ndarray, " theta"]] = (),
) -> Agreement | None:
    """Whether some recordings agree; None where there is one, or no two tell of the same.

    - `ends`: of a descent in each recording alone.
    - `biases`: of each end by its mesh; none where that was not judged. A lift that buckles
      elsewhere on a finer mesh leads far astray, pulls hardly. How far is told by one step, in
      which direction is not: each parameter is excused by itself, by `MOST` at most.

    The weighted scatter around the mean is compared with its chi-squared distribution. The one is
    named that adds to it what is least likely, see `odd_one`.
    """
    if len(problems) < 2:
        return None
    space = problems[0].space
    dim = space.dim
    mean, precision = (np.asarray(part, np.float64) for part in space.prior())
    excused = [bias[:dim] for bias in biases] or [np.zeros(dim)] * len(problems)
    exact: list[tuple[np.ndarray, np.ndarray]] = []
    for problem, end in zip(problems, ends, strict=True):
        place, covariance = _led((problem,), end, dim)
        if not (np.isfinite(place).all() and np.isfinite(covariance).all()):
            return None
        exact.append((place, covariance))
    led = [
        (place, covariance + np.diag(np.minimum(np.abs(by), MOST) ** 2))
        for (place, covariance), by in zip(exact, excused, strict=True)
    ]
    told = [told_by(*each, mean, precision) for each in led]
    if not scattered(told)[1]:
        return None
    without = chance([told_by(*each, mean, precision) for each in exact]) if biases else None
    weigh = weighing(problems)
    density = None
    if any(weigh) and not all(weigh):
        scaled = np.array([(r.name in SCALED) / r.width for r in space.ranges])
        every = [told_by(*each, mean, precision, least=SOME) for each in led]
        density = density_told(every, weigh, scaled, mean, precision)
    p, counts = chance(told), tuple(each.count for each in told)
    if not p < UNLIKELY:
        return Agreement(p, counts, None, density, without)
    odd = odd_one(told)
    rest = [each for i, each in enumerate(told) if i != odd]
    (here, own), (there, others) = (_known(each, mean, precision) for each in ([told[odd]], rest))
    errors = np.abs(here - there) / np.sqrt(np.diag(own) + np.diag(others))
    most = int(np.argmax(errors))
    of = space.ranges[most]
    first, second = (float(of.from_unit(jnp.asarray(at[most], float))) for at in (here, there))
    found = Contradiction(odd, of.name, float(errors[most]), (first, second))
    return Agreement(p, counts, found, density, without)


def weighing(problems: Problems) -> list[bool]:
    """Which recordings weigh the sheet: those of a force. No wind, whose own is in doubt: with ten
    times the density it is found ten times as strong, and stiffness with it."""
    return [problem.is_pulled for problem in problems]


def told_by(
    place: Float[np.ndarray, " dim"],
    covariance: Float[np.ndarray, "dim dim"],
    mean: Float[np.ndarray, " dim"],
    precision: Float[np.ndarray, "dim dim"],
    least: float = MORE,
) -> Told:
    """What an estimate tells without its prior of a `mean` and a `precision`, in directions that it
    knows `least` times as precisely."""
    root = np.linalg.cholesky(precision)
    inner = np.linalg.solve(root, np.linalg.inv(covariance))
    sizes, axes = np.linalg.eigh(np.linalg.solve(root, inner.T))
    kept = sizes > least
    beyond = np.where(kept, sizes - 1, 1)
    at, usual = (axes.T @ root.T @ each for each in (place, mean))
    alone = np.where(kept, (sizes * at - usual) / beyond, usual)
    forth = root @ axes
    information = (forth * np.where(kept, beyond, 0)[None]) @ forth.T
    return Told(np.linalg.solve(root.T, axes @ alone), information, int(kept.sum()))


def density_told(
    told: Sequence[Told],
    weigh: Sequence[bool],
    scaled: Float[np.ndarray, " dim"],
    mean: Float[np.ndarray, " dim"],
    precision: Float[np.ndarray, "dim dim"],
) -> tuple[float, float]:
    """The density with which recordings would agree best, over the one that was given, [-], and the
    standard error of its logarithm: by least squares, the fabric free.

    - `told`: by each, beside a prior of a `mean` and a `precision`.
    - `weigh`: which of them tell the density. In the others ten times the density moves like ten
      times all stiffness, whose places it moves along `scaled`, per unit of its logarithm.
    """
    dim = len(mean)
    matrix, right = np.zeros((dim + 1, dim + 1)), np.zeros(dim + 1)
    matrix[:dim, :dim], right[:dim] = precision, precision @ mean
    matrix[dim, dim] = 1 / HARDLY**2
    for each, weighs in zip(told, weigh, strict=True):
        moves = np.column_stack([np.eye(dim), np.zeros(dim) if weighs else scaled])
        matrix += moves.T @ each.information @ moves
        right += moves.T @ each.information @ each.place
    covariance = np.linalg.inv(matrix)
    given_too_high = (covariance @ right)[dim]
    return float(np.exp(-given_too_high)), float(np.sqrt(covariance[dim, dim]))


def asks_for_density(
    problems: Problems, found: Agreement | None, misfits: Sequence[Misfit]
) -> bool:
    """Whether some of several recordings weigh the sheet, and they or a force do not fit."""
    if len(problems) < 2 or not any(weighing(problems)):
        return False
    is_apart = found is not None and (found.contradiction is not None or found.doubts_density)
    return is_apart or any(each.what == FORCE for each in misfits)


def with_free_density(problems: Problems, theta: Theta) -> tuple[Problems, Theta]:
    """The problems with a density of which only the order is known, and a theta in its units."""
    place, given = problems[0].space.dim, problems[0].nuisance_prior.density
    loose = tuple(
        dataclasses.replace(p, nuisance_prior=p.nuisance_prior._replace(density=HARDLY))
        for p in problems
    )
    return loose, theta.at[place].multiply(given / HARDLY)


def with_density(found: Agreement | None, loose: Problems, end: Descent) -> Agreement | None:
    """An agreement with the density at the end of a descent in problems of `with_free_density`,
    over the one that was given, and the standard error of its logarithm. None stays None where that
    density is not doubted."""
    place = loose[0].space.dim
    covariance, _ = standard_errors.sandwich_of(loose, end, prior_weight(loose, end.normal))
    error = HARDLY * float(np.sqrt(covariance[place, place]))
    density = float(np.exp(HARDLY * float(end.theta[place]))), error
    judged = (found or Agreement(1.0, (0,) * len(loose), None))._replace(density=density)
    return judged if found or judged.doubts_density else None


def scattered(told: Sequence[Told]) -> tuple[float, int]:
    """Squared distances from the weighted mean, in standard errors, and the degrees of freedom."""
    total = np.sum([each.information for each in told], axis=0)
    led = np.sum([each.information @ each.place for each in told], axis=0)
    mean = np.linalg.pinv(total, rcond=RCOND, hermitian=True) @ led
    off = [(each.place - mean, each.information) for each in told]
    scatter = sum(float(away @ information @ away) for away, information in off)
    shared = np.linalg.matrix_rank(total, tol=RCOND * np.linalg.norm(total, 2), hermitian=True)
    return scatter, int(sum(each.count for each in told) - shared)


def chance(told: Sequence[Told]) -> float:
    """How likely recordings of one fabric scatter as much, [-]; 1 where no two tell of the same."""
    scatter, freedom = scattered(told)
    return float(stats.chi2.sf(scatter, freedom)) if freedom else 1.0


def odd_one(told: Sequence[Told]) -> int:
    """The index of the recording that adds to the scatter what is least likely by chance for the
    degrees of freedom that it adds. Of several alike, the last: of two, the second."""
    scatter, freedom = scattered(told)

    def likely(which: int) -> tuple[float, int]:
        others = [each for i, each in enumerate(told) if i != which]
        less, left = scattered(others)
        if left == freedom:  # it tells nothing that others tell
            return 0.0, -which
        return round(_log_chance(scatter - less, freedom - left), 6), -which

    return min(range(len(told)), key=likely)


def _log_chance(scatter: float, freedom: int) -> float:
    """The logarithm of the tail of chi squared, also where that is less than the least number: by
    the first term of its series, with which two such are still told apart."""
    found = float(stats.chi2.logsf(scatter, freedom))
    if np.isfinite(found):
        return found
    half = freedom / 2
    return float((half - 1) * np.log(scatter / 2) - scatter / 2 - special.gammaln(half))


def _known(told: Sequence[Told], mean, precision) -> tuple[np.ndarray, np.ndarray]:
    """Place and covariance by some recordings and the prior."""
    covariance = np.linalg.inv(precision + np.sum([each.information for each in told], axis=0))
    led = precision @ mean + np.sum([each.information @ each.place for each in told], axis=0)
    return covariance @ led, covariance


def _led(problems: Problems, end: Descent, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a recording leads with the prior, and its covariance there, nuisances free.

    How far it would go without bounds is an error of its place: no bound speaks for a recording.
    """
    prior = prior_weight(problems, end.normal)
    covariance, _ = standard_errors.sandwich_of(problems, end, prior)
    back = held_back(problems, end, float(prior))[:dim]
    known = np.asarray(covariance, np.float64)[:dim, :dim] + np.outer(back, back)
    return np.asarray(end.theta, np.float64)[:dim], known
