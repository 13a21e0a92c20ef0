"""Hypotheses about configurations: comparisons with a test each, and what they say together.

A comparison is a number for each fabric, the mean logarithm of the ratio of two distances, which is
above zero where the hypothesis is right. The fabrics are the sample: intervals and tests (Student's
t, with what motions and estimates add that fabrics have in common) are for fabrics like these.

A run that diverged has no distance. A comparison leaves it out, and with it what it is compared
with; in return nothing is found in favour of a side of which a run diverged.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from r2s.evaluation.crossed import CrossedMean, crossed_mean, interval, p_value, units_needed
from r2s.evaluation.statistics import SIGNIFICANCE, holm
from r2s.study.configuration import Configuration
from r2s.study.statistics.result_array import ResultArray, select
from r2s.study.statistics.samples import by_movement, finite_mean, log_distances, of_fabrics

MARGIN = 0.05  # an interval of the ratio within 1 +- this says that there is no difference
Answer = Literal["holds", "does not hold", "cannot be told"]


@dataclass(frozen=True)
class Comparison:
    """One test of a hypothesis; `lacking` says why there is none.

    - `found`: the mean over fabrics of the logarithm of the ratio (of what `words` say, where it
      is no ratio), above zero where the hypothesis is right.
    - `agreeing`: in how many of the fabrics it is above zero.
    - `diverged`: runs that did, of the side that should be smaller, and of the larger.
    - `is_ratio`: whether `found` is a logarithm.
    - `paper`: the two averages that the paper's tables have for it, [-], where there are any.
    """

    words: str
    found: CrossedMean = CrossedMean(np.nan, 0, np.nan, 0.0, np.nan)
    agreeing: int = 0
    diverged: tuple[int, int] = (0, 0)
    is_ratio: bool = True
    paper: tuple[float, float] | None = None
    lacking: str = ""

    @property
    def ratio(self) -> float:
        """The geometric mean of the ratio; NaN where there is none."""
        return float(np.exp(self.found.mean)) if self.is_ratio else np.nan

    @property
    def ends(self) -> tuple[float, float]:
        """Of the interval of the ratio; NaN for one fabric."""
        low, high = np.exp(interval(self.found)).tolist()
        return (low, high) if self.is_ratio else (np.nan, np.nan)

    @property
    def p(self) -> float:
        """Two-sided, before correction; NaN for one fabric, or none."""
        return p_value(self.found)


@dataclass(frozen=True)
class Claim:
    """A conclusion in words, which holds where all its comparisons hold, and a note to it."""

    words: str
    comparisons: tuple[Comparison, ...]
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """The answer to a claim, and for each of its comparisons an answer, the corrected p, and how
    many fabrics would tell such a difference (`needed`)."""

    claim: Claim
    answer: Answer
    answers: tuple[Answer, ...]
    corrected: tuple[float, ...]
    needed: tuple[tuple[float, float, float], ...]


def compare(
    words: str,
    results: ResultArray,
    smaller: Sequence[Configuration],
    larger: Sequence[Configuration],
    paper: tuple[float, float] | None = None,
) -> Comparison:
    """Compare configurations over the trajectories that they share.

    - `smaller`, `larger`: which are expected to have the smaller and the larger distances. Of
      several the geometric mean counts.
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
    logs = log_distances(part)
    of_repeats = logs[second].mean(axis=0) - logs[first].mean(axis=0)
    over_repeats = finite_mean(logs, 2)
    values = over_repeats[second].mean(axis=0) - over_repeats[first].mean(axis=0)
    lost = int(part.diverged[first].sum()), int(part.diverged[second].sum())
    return compared(
        words,
        of_fabrics(part, values),
        (by_movement(part, values), of_fabrics(part, of_repeats.T).T),
        lost,
        paper,
    )


def compared(
    words: str,
    numbers: Float[np.ndarray, " fabric"],
    tables: Iterable[Float[np.ndarray, "fabric _"]] = (),
    diverged: tuple[int, int] = (0, 0),
    paper: tuple[float, float] | None = None,
    is_ratio: bool = True,
) -> Comparison:
    """The comparison whose numbers are given; see `Comparison`, and `crossed_mean` for `tables`.

    Fabrics without a number (NaN) do not count.
    """
    kept = np.isfinite(numbers)
    if not kept.any():
        why = "all of it diverged" if sum(diverged) else "nothing that both were judged on"
        return Comparison(words, diverged=diverged, paper=paper, lacking=why)
    numbers = numbers[kept]
    return Comparison(
        words,
        found=crossed_mean(numbers, [table[kept] for table in tables]),
        agreeing=int((numbers > 0).sum()),
        diverged=diverged,
        is_ratio=is_ratio,
        paper=paper,
    )


def judge(claims: Sequence[Claim]) -> list[Verdict]:
    """The answers, after Holm's correction for all comparisons of all claims.

    A comparison holds where p is below `SIGNIFICANCE` and speaks for it. It does not hold where p
    speaks against it, or where the interval of the ratio says that there is no difference to speak
    of (`MARGIN`). Nothing is told in favour of a side of which a run diverged. A claim does not
    hold as soon as one of its comparisons does not.

    Fabrics needed are for a ratio as far from one as that found, but at least by `MARGIN`, and for
    the first step of Holm's correction.
    """
    p = [comparison.p for claim in claims for comparison in claim.comparisons]
    corrected = iter(holm(p).tolist())
    significance = SIGNIFICANCE / max(1, int(np.isfinite(p).sum()))
    verdicts = []
    for claim in claims:
        own = tuple(next(corrected) for _ in claim.comparisons)
        answers: list[Answer] = [_answer(c, q) for c, q in zip(claim.comparisons, own, strict=True)]
        needed = tuple(_needed(comparison, significance) for comparison in claim.comparisons)
        verdicts.append(Verdict(claim, _together(answers), tuple(answers), own, needed))
    return verdicts


def _answer(comparison: Comparison, p: float) -> Answer:
    if comparison.lacking:
        return "cannot be told"
    low, high = comparison.ends
    if 1 / (1 + MARGIN) < low and high < 1 + MARGIN and not any(comparison.diverged):
        return "does not hold"
    is_favoured = comparison.found.mean > 0
    if p < SIGNIFICANCE and not comparison.diverged[0 if is_favoured else 1]:
        return "holds" if is_favoured else "does not hold"
    return "cannot be told"


def _needed(comparison: Comparison, significance: float) -> tuple[float, float, float]:
    effect = max(abs(comparison.found.mean), np.log1p(MARGIN))
    return units_needed(comparison.found, effect, significance)


def _together(answers: Sequence[Answer]) -> Answer:
    if "does not hold" in answers:
        return "does not hold"
    return "holds" if answers and all(a == "holds" for a in answers) else "cannot be told"
