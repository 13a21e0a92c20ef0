"""Which conclusions of the study hold on our rows: answers, with their numbers."""

from collections.abc import Sequence

import numpy as np

from r2s.evaluation.crossed import MOST_UNITS, POWER
from r2s.evaluation.statistics import LEVEL, SIGNIFICANCE
from r2s.study.rows import Row
from r2s.study.statistics.conclusions import CONCLUSIONS
from r2s.study.statistics.hypotheses import Comparison, Verdict, judge
from r2s.study.statistics.paper import Paper
from r2s.study.statistics.result_array import ResultArray, result_array, select
from r2s.study.tables import MISSING, Table, significant

MOST_IN_WORDS = 3


def find(rows: Sequence[Row], paper: Paper, metric: str = "chamfer") -> list[Verdict]:
    """The answers to all conclusions, by one metric."""
    return find_in(result_array(rows, metric), paper)


def find_in(results: ResultArray, paper: Paper) -> list[Verdict]:
    """The answers to all conclusions, by all configurations but those of published recipes."""
    own = select(results, lambda configuration: not configuration.is_published)
    return judge([conclusion(own, paper) for conclusion in CONCLUSIONS])


def finding_table(verdicts: Sequence[Verdict], metric: str) -> Table:
    """A line a comparison: what it says, in numbers."""
    lines = tuple(
        (
            verdict.claim.words,
            verdict.answer,
            comparison.words,
            answer if not comparison.lacking else f"cannot be told: {comparison.lacking}",
            *_numbers(comparison, p),
            MISSING if comparison.lacking or answer != "cannot be told" else _needed(p, needed),
            _quoted(comparison),
        )
        for verdict in verdicts
        for comparison, answer, p, needed in zip(
            verdict.claim.comparisons,
            verdict.answers,
            verdict.corrected,
            verdict.needed,
            strict=True,
        )
    )
    header = ("conclusion", "answer", "comparison", "answer to it", "ratio",
              f"{LEVEL:.0%} interval", "p (Holm)", "fabrics that agree", "diverged",
              "fabrics needed", "paper (CD)")  # fmt: skip
    return Table(
        header,
        lines,
        f"Conclusions of the paper, tested on our {metric}, for fabrics like these: the fabrics "
        "are the sample. Ratio: the geometric mean over fabrics (above 1 where the conclusion is "
        "right), with Student's interval and test, and Holm's correction. Diverged: runs of the "
        "side that should be smaller, and of the larger; they have no ratio, and nothing is found "
        "in favour of a side that has any. Fabrics needed: to tell a ratio as far from 1 as this "
        f"with a power of {POWER:.0%}; in brackets by the ends of the {LEVEL:.0%} interval of the "
        "spread between fabrics; where it is above any number more motions or estimates are needed "
        "too. Paper: averages of Chamfer distances, which are squared.",
    )


def _numbers(comparison: Comparison, p: float) -> tuple[str, ...]:
    lost = MISSING
    if any(comparison.diverged):
        lost = "{} and {}".format(*comparison.diverged)
    if comparison.lacking:
        return (*(MISSING,) * 4, lost)
    low, high = comparison.ends
    return (
        significant(comparison.ratio) if np.isfinite(comparison.ratio) else MISSING,
        f"{significant(low)} to {significant(high)}" if np.isfinite(low) else MISSING,
        f"{p:.2g}" if np.isfinite(p) else MISSING,
        f"{comparison.agreeing} of {comparison.found.units}",
        lost,
    )


def _needed(p: float, needed: tuple[float, float, float]) -> str:
    """How many fabrics it would take, likely and between which numbers."""
    if p < SIGNIFICANCE:  # what is better has diverged
        return "no number, while runs diverge"
    if np.isnan(needed[0]):
        return "not known from one fabric"
    likely, fewest, most = (
        f"{number:.0f}" if np.isfinite(number) else f"more than {MOST_UNITS}" for number in needed
    )
    return likely if fewest == most else f"{likely} ({fewest} to {most})"


def _quoted(comparison: Comparison) -> str:
    if comparison.paper is None:
        return MISSING
    return " against ".join(f"{value:.3f}" for value in comparison.paper)


def in_words(verdict: Verdict) -> str:
    """The answer and what it rests on: all comparisons, or of many those that decide."""
    claim = verdict.claim
    judged = list(
        zip(claim.comparisons, verdict.answers, verdict.corrected, verdict.needed, strict=True)
    )
    shown = judged
    if len(judged) > MOST_IN_WORDS:
        refuted = [each for each in judged if each[1] == "does not hold"]
        open_ones = [each for each in judged if each[1] == "cannot be told"]
        closest = min(judged, key=lambda each: np.nan_to_num(each[0].ratio, nan=np.inf))
        shown = (refuted or open_ones or [closest])[:MOST_IN_WORDS]
    said = "; ".join(_said(*each) for each in shown)
    said = said[:1].upper() + said[1:]
    rest = f"; and {len(judged) - len(shown)} more in the table" if len(shown) < len(judged) else ""
    note = f" {claim.note}" if claim.note else ""
    return f"{verdict.answer.capitalize()}: {claim.words} {said}{rest}.{note}"


def _said(comparison: Comparison, answer: str, p: float, needed: tuple[float, float, float]) -> str:
    quoted = ""
    if comparison.paper is not None:
        ours, theirs = comparison.paper
        quoted = f"; the paper has {theirs / ours:.2g} times in squared units"
    if comparison.lacking:
        return f"{comparison.words}: {comparison.lacking}{quoted}"
    ratio, ends, p_shown, agree, lost = _numbers(comparison, p)
    told = [f"{ratio} times ({ends})"] if comparison.is_ratio else []
    told += [f"p = {p_shown}", f"{agree} fabrics"]
    if lost != MISSING:
        told.append(f"{lost} runs of the two sides diverged (not in the ratio)")
    if answer == "cannot be told":
        told.append(f"fabrics that would tell: {_needed(p, needed)}")
    return f"{comparison.words}: {', '.join(told)}{quoted}"
