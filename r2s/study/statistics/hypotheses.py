"""Hypotheses about configurations: comparisons with a test each, and what they say together.

A comparison is paired: it has two values for each trajectory (or fabric), and the ratio of the
second to the first, which is above one where the hypothesis is right. Wilcoxon's signed-rank test
says whether the ratios are not centred on one. Trajectories of a fabric share its estimates, so
that the test is surer than it should be where fabrics are few: the interval of the mean ratio, by a
bootstrap over trajectories and repeats, and the count of fabrics that agree stand beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from r2s.evaluation.statistics import SIGNIFICANCE, holm, interval, signed_rank
from r2s.study.configuration import Configuration
from r2s.study.statistics.result_array import (
    ResultArray,
    Weights,
    mean_over_repeats,
    resamples,
    select,
)

MARGIN = 0.05  # an interval of the ratio within 1 +- this says that there is no difference
Answer = Literal["holds", "does not hold", "cannot be told"]

# The logarithm of the ratio of each pair, and how often it was drawn.
Ratios = Callable[[Weights | None], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Comparison:
    """One test of a hypothesis; `lacking` says why there is none.

    - `pairs`: how many there are; `diverged`: those of which one diverged.
    - `ratio`: the geometric mean over pairs of which neither diverged, above 1 where the hypothesis
      is right. `low`, `high`: its interval.
    - `p`: two-sided, before correction, of all pairs. `favoured`: the test is for the hypothesis.
    - `agreeing`, `fabrics`: in how many of the fabrics the median ratio is above 1.
    - `paper`: the two averages that the paper's tables have for it, [-], where there are any.
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
    """A conclusion in words, which holds where all its comparisons hold, and a note to it."""

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
    results: ResultArray,
    smaller: Sequence[Configuration],
    larger: Sequence[Configuration],
    paper: tuple[float, float] | None = None,
) -> Comparison:
    """Compare configurations over the trajectories that they share.

    - `smaller`, `larger`: which are expected to have the smaller and the larger distances. Of
      several the geometric mean counts. A mean with a repeat that diverged is larger than any that
      has none.
    - `paper`: what the paper's tables have for it.
    """
    missing = [c.label for c in (*smaller, *larger) if c not in results.configurations]
    if missing:
        return Comparison(words, lacking=f"no rows of {', '.join(missing)}", paper=paper)
    part = select(results, {*smaller, *larger}.__contains__)
    complete = np.asarray(part.present.any(axis=2).all(axis=0))
    kept = {t for t, keep in zip(part.trajectories, complete, strict=True) if keep}
    part = select(part, trajectories=kept.__contains__)
    first, second = ([part.configurations.index(c) for c in side] for side in (smaller, larger))

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        values = np.log(mean_over_repeats(part, weights))
        with np.errstate(invalid="ignore"):  # both diverged: no difference
            differences = values[second].mean(axis=0) - values[first].mean(axis=0)
        counts = np.ones(len(part.trajectories)) if weights is None else weights.trajectory
        return np.where(np.isnan(differences), 0.0, differences), counts

    return paired(words, part, [t.fabric for t in part.trajectories], ratios, paper)


def paired(
    words: str,
    results: ResultArray,
    fabrics: Sequence[str],
    ratios: Ratios,
    paper: tuple[float, float] | None = None,
) -> Comparison:
    """Compare pairs whose ratios are given, and resampled as `results` is.

    `fabrics`: that of each pair. For `paper` see `compare`.
    """
    found, _ = ratios(None)
    if not len(found):
        return Comparison(words, paper=paper, lacking="nothing that both were judged on")
    low, high = interval(np.exp([_mean(*ratios(weights)) for weights in resamples(results)]))
    of_pair = np.array(fabrics)
    agree = [np.median(found[of_pair == fabric]) > 0 for fabric in dict.fromkeys(fabrics)]
    p, favoured = signed_rank(found)
    return Comparison(
        words,
        pairs=len(found),
        ratio=float(np.exp(_mean(found, np.ones(len(found))))),
        low=low,
        high=high,
        p=p,
        favoured=favoured,
        agreeing=int(sum(agree)),
        fabrics=len(agree),
        paper=paper,
        diverged=int(np.isinf(found).sum()),
    )


def _mean(values: np.ndarray, counts: np.ndarray) -> float:
    known = np.isfinite(values) & (counts > 0)
    return float(np.average(values[known], weights=counts[known])) if known.any() else np.nan


def judge(claims: Sequence[Claim]) -> list[Verdict]:
    """The answers, after Holm's correction for all comparisons of all claims.

    A comparison holds where p is below `SIGNIFICANCE` and speaks for it. It does not hold where p
    speaks against it, or where the interval of the ratio says that there is no difference to speak
    of (`MARGIN`). A claim does not hold as soon as one of its comparisons does not.
    """
    corrected = iter(holm([c.p for claim in claims for c in claim.comparisons]).tolist())
    verdicts = []
    for claim in claims:
        p = tuple(next(corrected) for _ in claim.comparisons)
        answers: list[Answer] = [_answer(c, q) for c, q in zip(claim.comparisons, p, strict=True)]
        verdicts.append(Verdict(claim, _together(answers), tuple(answers), p))
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
