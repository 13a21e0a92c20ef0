"""Which column is best more often: ranks within each trajectory, and whether they differ.

Distances of trajectories differ by more than those of columns; ranks within a trajectory are
comparable. Demsar 2006, Statistical comparisons of classifiers over multiple data sets.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from r2s.study.statistics.panel import (
    LEVEL,
    Column,
    Panel,
    interval,
    over_repeats,
    resamples,
    select,
)
from r2s.study.statistics.tables import MISSING, Table, significant

SIGNIFICANCE = 0.05


class Friedman(NamedTuple):
    """Friedman's test that all columns are alike: its statistic, p, and how many blocks it saw."""

    statistic: float
    p: float
    blocks: int


class Ranks(NamedTuple):
    """Mean ranks, 1 the best, of the columns that were all judged on the same trajectories.

    - `low`, `high`: interval by a bootstrap over trajectories and repeats. Means of resampled
      repeats scatter more than those of all, so that intervals reach to the middle rather too far.
    - `first`: the share of trajectories in which a column is the best.
    - `trajectories`: how many count; `left_out`: columns that lack most of them.
    - `by_trajectory`: the test of all but default fabrics with trajectories as blocks, which takes
      those of one fabric, with the same estimates, for independent; `by_fabric`: with fabrics.
    - `difference`: by which two mean ranks must differ to be told apart (Nemenyi), with
      trajectories as blocks.
    """

    columns: tuple[Column, ...]
    mean: Float[np.ndarray, " column"]
    low: Float[np.ndarray, " column"]
    high: Float[np.ndarray, " column"]
    first: Float[np.ndarray, " column"]
    trajectories: int
    left_out: tuple[Column, ...]
    by_trajectory: Friedman
    by_fabric: Friedman
    difference: float


def rank(panel: Panel) -> Ranks | None:
    """The ranks of the columns of a panel; None where fewer than two share a trajectory.

    Ranks are of means over repeats. A mean with a repeat that diverged is last, together with the
    others of that kind. Columns that lack more than half of the trajectories are left out, and
    then trajectories that one of the others lacks.
    """
    there = np.asarray(panel.present.any(axis=2))
    kept = there.mean(axis=1) >= 0.5 if there.size else np.zeros(len(there), bool)
    complete = np.asarray(there[kept].all(axis=0))
    wanted = {c for c, keep in zip(panel.columns, kept, strict=True) if keep}
    used = {t for t, keep in zip(panel.trajectories, complete, strict=True) if keep}
    part = select(panel, wanted.__contains__, used.__contains__)
    if len(part.columns) < 2 or not part.trajectories:
        return None
    values = over_repeats(part)
    ranks = _ranks(values)
    drawn = np.array(
        [
            np.average(_ranks(over_repeats(part, weights)), axis=1, weights=weights.trajectory)
            for weights in resamples(part)
        ]
    )
    ends = np.array([interval(samples) for samples in drawn.T])
    fabrics = list(dict.fromkeys(t.fabric for t in part.trajectories))
    of_fabric = np.stack(
        [ranks[:, [t.fabric == f for t in part.trajectories]].mean(axis=1) for f in fabrics], axis=1
    )
    best = ranks == ranks.min(axis=0)
    estimates = [bool(column.approach) for column in part.columns]
    return Ranks(
        part.columns,
        ranks.mean(axis=1),
        ends[:, 0],
        ends[:, 1],
        (best / best.sum(axis=0)).mean(axis=1),
        len(part.trajectories),
        tuple(c for c in panel.columns if c not in wanted),
        _friedman(ranks[estimates]),
        _friedman(of_fabric[estimates]),
        critical_difference(len(part.columns), len(part.trajectories)),
    )


def critical_difference(columns: int, blocks: int) -> float:
    """Nemenyi's: two of `columns` mean ranks over `blocks` differ where they are as far apart."""
    studentized = stats.studentized_range.ppf(1 - SIGNIFICANCE, columns, np.inf) / np.sqrt(2)
    return float(studentized * np.sqrt(columns * (columns + 1) / (6 * blocks)))


def _ranks(values: np.ndarray) -> np.ndarray:
    return stats.rankdata(values, axis=0)


def _friedman(values: Float[np.ndarray, "column block"]) -> Friedman:
    """Friedman's test; NaN where SciPy has none: fewer than three columns, or two blocks."""
    columns, blocks = values.shape
    if columns < 3 or blocks < 2 or np.all(values == values[:1]):
        return Friedman(np.nan, np.nan, blocks)
    found = stats.friedmanchisquare(*values)
    return Friedman(float(found.statistic), float(found.pvalue), blocks)


def rank_table(found: Mapping[str, Ranks], caption: str) -> Table:
    """Mean ranks by motion: a line a column, the best of the last motion first."""
    last = list(found.values())[-1]
    order = [last.columns[i] for i in np.argsort(last.mean, kind="stable")]
    order += [c for each in found.values() for c in each.columns if c not in last.columns]
    shown = {motion: _cells(each) for motion, each in found.items()}
    lines = tuple(
        (column.label, *(cells.get(column, MISSING) for cells in shown.values()))
        for column in dict.fromkeys(order)
    )
    words = " ".join(f"{motion.capitalize()}: {explained(each)}" for motion, each in found.items())
    return Table(
        ("column", *found),
        lines,
        f"{caption}: mean rank (1 is best), {LEVEL:.0%} interval, and how often the best of all. "
        f"{words}",
    )


def _cells(ranks: Ranks) -> dict[Column, str]:
    numbers = zip(
        ranks.columns, *(x.tolist() for x in (ranks.mean, ranks.low, ranks.high, ranks.first)),
        strict=True,
    )  # fmt: skip
    return {
        column: f"{mean:.2f} [{low:.2f}, {high:.2f}], {100 * first:.0f} %"
        for column, mean, low, high, first in numbers
    }


def explained(ranks: Ranks) -> str:
    """The tests in words."""
    words = [f"{len(ranks.columns)} columns, {ranks.trajectories} trajectories"]
    for what, test in (("trajectories", ranks.by_trajectory), ("fabrics", ranks.by_fabric)):
        if np.isfinite(test.p):
            words.append(
                f"Friedman's test with {test.blocks} {what} as blocks: chi² = "
                f"{significant(test.statistic)}, p = {test.p:.2g}"
            )
        else:
            words.append(f"Friedman's test with {test.blocks} {what} as blocks cannot be made")
    words.append(f"mean ranks differ from {ranks.difference:.2f} on (Nemenyi, trajectories)")
    if ranks.left_out:
        missing = ", ".join(column.label for column in ranks.left_out)
        words.append(f"left out, judged on less than half: {missing}")
    return "; ".join(words) + "."
