"""Which conclusions of the study hold on our rows: answers, with their numbers."""

from collections.abc import Sequence

import numpy as np

from r2s.evaluation.statistics import LEVEL
from r2s.study.rows import Row
from r2s.study.statistics.conclusions import CONCLUSIONS
from r2s.study.statistics.hypotheses import Comparison, Verdict, judge
from r2s.study.statistics.paper import Paper
from r2s.study.statistics.result_array import result_array
from r2s.study.tables import MISSING, Table, significant

MOST_IN_WORDS = 3


def find(rows: Sequence[Row], paper: Paper, metric: str = "chamfer") -> list[Verdict]:
    """The answers to all conclusions, by one metric."""
    results = result_array(rows, metric)
    return judge([conclusion(results, paper) for conclusion in CONCLUSIONS])


def finding_table(verdicts: Sequence[Verdict], metric: str) -> Table:
    """A line a comparison: what it says, in numbers."""
    lines = tuple(
        (
            verdict.claim.words,
            verdict.answer,
            comparison.words,
            answer if not comparison.lacking else f"cannot be told: {comparison.lacking}",
            *_numbers(comparison, p),
        )
        for verdict in verdicts
        for comparison, answer, p in zip(
            verdict.claim.comparisons, verdict.answers, verdict.corrected, strict=True
        )
    )
    header = ("conclusion", "answer", "comparison", "answer to it", "ratio",
              f"{LEVEL:.0%} interval", "p (Holm)", "pairs", "fabrics that agree",
              "paper (CD)")  # fmt: skip
    return Table(
        header,
        lines,
        f"Conclusions of the paper, tested on our {metric}: ratio, the geometric mean "
        "over pairs that did not diverge (above 1 where the conclusion is right); Wilcoxon's "
        "signed-rank test of all pairs with Holm's correction. Paper: averages of Chamfer "
        "distances, which are squared.",
    )


def _numbers(comparison: Comparison, p: float) -> tuple[str, ...]:
    paper = MISSING
    if comparison.paper is not None:
        paper = " against ".join(f"{value:.3f}" for value in comparison.paper)
    if comparison.lacking:
        return (MISSING,) * 5 + (paper,)
    agree = f"{comparison.agreeing} of {comparison.fabrics}" if comparison.fabrics else MISSING
    return (
        significant(comparison.ratio),
        f"{significant(comparison.low)} to {significant(comparison.high)}",
        f"{p:.2g}",
        str(comparison.pairs),
        agree,
        paper,
    )


def in_words(verdict: Verdict) -> str:
    """The answer and what it rests on: all comparisons, or of many those that decide."""
    claim = verdict.claim
    judged = list(zip(claim.comparisons, verdict.answers, verdict.corrected, strict=True))
    shown = judged
    if len(judged) > MOST_IN_WORDS:
        refuted = [each for each in judged if each[1] == "does not hold"]
        open_ones = [each for each in judged if each[1] == "cannot be told"]
        closest = min(judged, key=lambda each: np.nan_to_num(each[0].ratio, nan=np.inf))
        shown = (refuted or open_ones or [closest])[:MOST_IN_WORDS]
    said = "; ".join(_said(comparison, p) for comparison, _, p in shown)
    said = said[:1].upper() + said[1:]
    rest = f"; and {len(judged) - len(shown)} more in the table" if len(shown) < len(judged) else ""
    note = f" {claim.note}" if claim.note else ""
    return f"{verdict.answer.capitalize()}: {claim.words} {said}{rest}.{note}"


def _said(comparison: Comparison, p: float) -> str:
    quoted = ""
    if comparison.paper is not None:
        ours, theirs = comparison.paper
        quoted = f"; the paper has {theirs / ours:.2g} times in squared units"
    if comparison.lacking:
        return f"{comparison.words}: {comparison.lacking}{quoted}"
    ratio, ends, p_shown, pairs, agree, _ = _numbers(comparison, p)
    fabrics = f", {agree} fabrics" if agree != MISSING else ""
    if comparison.diverged:
        fabrics += f", {comparison.diverged} pairs with one that diverged (in p, not in the ratio)"
    return (
        f"{comparison.words}: {ratio} times ({ends}), p = {p_shown}, {pairs} pairs{fabrics}{quoted}"
    )
