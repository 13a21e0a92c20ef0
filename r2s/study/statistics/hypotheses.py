"""Hypotheses about columns: comparisons with a test each, and what they say together.

A comparison is paired: two values for each trajectory (or fabric), and the ratio of the second to
the first, which is above one where the hypothesis is right. Wilcoxon's signed-rank test says
whether the ratios are not centred on one. Trajectories of a fabric share its estimates, so that
the test is surer than it should be where fabrics are few: the interval of the mean ratio, by a
bootstrap over trajectories and repeats, and the count of fabrics that agree stand beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy import stats

from r2s.study.statistics.panel import (
    Column,
    Panel,
    Weights,
    interval,
    over_repeats,
    resamples,
    select,
)

SIGNIFICANCE = 0.05  # after Holm's correction for all comparisons of a report
MARGIN = 0.05  # an interval of the ratio within 1 +- this says that there is no difference
Answer = Literal["holds", "does not hold", "cannot be told"]

# The logarithm of the ratio of each pair, and how often it was drawn.
Ratios = Callable[[Weights | None], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Comparison:
    """One test of a hypothesis; `lacking` says why there is none.

    - `ratio`: the geometric mean over pairs of which neither diverged, above 1 where the hypothesis
      is right; `low`, `high`: its interval; `pairs`: how many, and those that `diverged` of them.
    - `p`: two-sided, before correction, of all pairs; `favoured`: the test is for the hypothesis.
    - `agreeing`, `fabrics`: in how many of the fabrics the median ratio is above 1.
    - `paper`: the two averages that the study's tables have for it, [-], where there are any.
    """

    words: str
    pairs: int = 0
    ratio: float = np.nan
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    favoured: bool = False
    agreeing: int = 0
    fabrics: int = 0
    paper: tuple[float, float] | None = None
    diverged: int = 0
    lacking: str = ""


@dataclass(frozen=True)
class Claim:
    """A conclusion in words, which holds where all its comparisons hold; `note`: what else is."""

    words: str
    comparisons: tuple[Comparison, ...]
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """The answer to a claim, that to each of its comparisons, and their corrected p."""

    claim: Claim
    answer: Answer
    answers: tuple[Answer, ...]
    corrected: tuple[float, ...]


def compare(
    words: str,
    panel: Panel,
    smaller: Sequence[Column],
    larger: Sequence[Column],
    paper: tuple[float, float] | None = None,
) -> Comparison:
    """Whether `smaller` columns have the smaller distances, over the trajectories they share.

    Of several columns the geometric mean counts. A mean with a repeat that diverged is larger than
    any that has none.
    """
    there = [column for column in panel.columns if column in {*smaller, *larger}]
    if lacking := _lacking(there, [*smaller, *larger]):
        return Comparison(words, lacking=lacking, paper=paper)
    part = select(panel, there.__contains__)
    complete = np.asarray(part.present.any(axis=2).all(axis=0))
    kept = {t for t, keep in zip(part.trajectories, complete, strict=True) if keep}
    part = select(part, trajectories=kept.__contains__)
    first, second = ([part.columns.index(c) for c in side] for side in (smaller, larger))

    fabrics = [trajectory.fabric for trajectory in part.trajectories]

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        values = np.log(over_repeats(part, weights))
        with np.errstate(invalid="ignore"):  # both diverged: no difference
            differences = values[second].mean(axis=0) - values[first].mean(axis=0)
        counts = np.ones(len(fabrics)) if weights is None else weights.trajectory
        return np.where(np.isnan(differences), 0.0, differences), counts

    return paired(words, part, fabrics, ratios, paper)


def _lacking(there: Sequence[Column], needed: Sequence[Column]) -> str:
    missing = [column.label for column in needed if column not in there]
    return f"no rows of {', '.join(missing)}" if missing else ""


def paired(
    words: str,
    panel: Panel,
    fabrics: Sequence[str],
    ratios: Ratios,
    paper: tuple[float, float] | None = None,
) -> Comparison:
    """The comparison of pairs, of which `fabrics` are given, resampled as `panel` is."""
    found, _ = ratios(None)
    if not len(found):
        return Comparison(words, paper=paper, lacking="nothing that both were judged on")
    low, high = interval(np.exp([_mean(*ratios(weights)) for weights in resamples(panel)]))
    mine = np.array(fabrics)
    agree = [np.median(found[mine == fabric]) > 0 for fabric in dict.fromkeys(fabrics)]
    return Comparison(
        words,
        len(found),
        float(np.exp(_mean(found, np.ones(len(found))))),
        low,
        high,
        *signed_rank(found),
        int(sum(agree)),
        len(agree),
        paper,
        int(np.isinf(found).sum()),
    )


def signed_rank(differences: Float[np.ndarray, " pair"]) -> tuple[float, bool]:
    """Two-sided p of Wilcoxon's signed-rank test, and whether it speaks for a positive centre.

    Infinite differences rank last, zeros drop.
    """
    finite = np.abs(differences[np.isfinite(differences)])
    bound = 2 * finite.max(initial=1.0)
    differences = np.clip(differences, -bound, bound)
    differences = differences[differences != 0]
    if not len(differences):
        return 1.0, False
    found: Any = stats.wilcoxon(differences)
    ranks = np.sign(differences) * stats.rankdata(np.abs(differences))
    return float(found.pvalue), bool(ranks.sum() > 0)


def _mean(values: np.ndarray, counts: np.ndarray) -> float:
    known = np.isfinite(values) & (counts > 0)
    return float(np.average(values[known], weights=counts[known])) if known.any() else np.nan


def holm(p: Sequence[float]) -> np.ndarray:
    """Holm's correction for as many tests as there are finite numbers; NaN stays."""
    values = np.asarray(p, float)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(values[known], kind="stable")]
    corrected = np.full(len(values), np.nan)
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(values[order] * factors))
    return corrected


def judge(claims: Sequence[Claim]) -> list[Verdict]:
    """The answers, after Holm's correction for all comparisons of all claims.

    A comparison holds where p is below SIGNIFICANCE and speaks for it; it does not hold where p
    speaks against it, or where the interval of the ratio says that there is no difference to speak
    of (MARGIN). A claim does not hold as soon as one of its comparisons does not.
    """
    corrected = holm([c.p for claim in claims for c in claim.comparisons])
    verdicts, start = [], 0
    for claim in claims:
        p = [float(q) for q in corrected[start : start + len(claim.comparisons)]]
        start += len(claim.comparisons)
        answers: list[Answer] = [_answer(c, q) for c, q in zip(claim.comparisons, p, strict=True)]
        verdicts.append(Verdict(claim, _together(answers), tuple(answers), tuple(p)))
    return verdicts


def _answer(comparison: Comparison, p: float) -> Answer:
    if comparison.lacking:
        return "cannot be told"
    is_near = 1 / (1 + MARGIN) < comparison.low and comparison.high < 1 + MARGIN
    is_alike = is_near and not comparison.diverged
    if p < SIGNIFICANCE and not is_alike:
        return "holds" if comparison.favoured else "does not hold"
    return "does not hold" if is_alike else "cannot be told"


def _together(answers: Sequence[Answer]) -> Answer:
    if "does not hold" in answers:
        return "does not hold"
    return "holds" if answers and all(a == "holds" for a in answers) else "cannot be told"
