"""Which configuration is best more often: ranks within each recording, and whether they differ.

Distances of recordings differ by more than those of configurations; ranks within a recording are
comparable. Demsar 2006, Statistical comparisons of classifiers over multiple data sets.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from r2s.metrics.statistics import SIGNIFICANCE, crossed_mean, interval


class Ranks(NamedTuple):
    """Mean ranks, 1 the best, of the configurations that were judged on the same recordings.

    - `table`: by configuration `mean` over fabrics, `low` and `high` of its interval, and `first`,
      the share of recordings in which it is the best.
    - `recordings`, `fabrics`: how many count. `left_out`: configurations that lack most of them.
    - `p`: of Friedman's test of all but default fabrics, with fabrics as blocks; NaN for fewer than
      three configurations or two fabrics.
    - `difference`: by which two mean ranks must differ to be told apart (Nemenyi).
    """

    table: pd.DataFrame
    recordings: int
    fabrics: int
    left_out: list[str]
    p: float
    difference: float


def rank(results: pd.DataFrame) -> Ranks | None:
    """The ranks by one metric of estimates and defaults, from `frame.labelled`; None where fewer
    than two share a recording.

    Ranks are of means over repeats. A mean with a repeat that diverged is last. Configurations that
    lack more than half of the recordings are left out, then recordings that another one lacks.
    """
    own = results[results.baseline.isin(("", "default"))]
    own = own.assign(value=own.value.where(~own.diverged, np.inf))
    place = ["fabric", "movement"]
    table = own.groupby([*place, "configuration"], observed=True).value.mean().unstack()
    is_kept = table.notna().mean() >= 0.5
    left_out = list(map(str, table.columns[~is_kept]))
    table = table.loc[:, is_kept].dropna()
    if len(table.columns) < 2 or table.empty:
        return None
    ranks = table.rank(axis=1)
    of_fabric = ranks.groupby("fabric").mean()
    ends = [
        interval(crossed_mean(of_fabric[each].to_numpy(), [ranks[each].unstack().to_numpy()]))
        for each in ranks.columns
    ]
    low, high = np.clip(np.array(ends).T, 1, len(ranks.columns))
    is_best = ranks.eq(ranks.min(axis=1), axis=0)
    first = is_best.div(is_best.sum(axis=1), axis=0).mean()
    found = pd.DataFrame({"mean": of_fabric.mean(), "low": low, "high": high, "first": first})
    defaults = set(own[own.baseline == "default"].configuration)
    tested = of_fabric.loc[:, [each not in defaults for each in of_fabric.columns]].T.to_numpy()
    can_test = len(tested) > 2 and len(of_fabric) > 1 and np.ptp(tested, axis=0).any()
    return Ranks(
        table=found.sort_values("mean", kind="stable"),
        recordings=len(table),
        fabrics=len(of_fabric),
        left_out=left_out,
        p=float(stats.friedmanchisquare(*tested).pvalue) if can_test else np.nan,
        difference=critical_difference(len(ranks.columns), len(of_fabric)),
    )


def in_words(ranks: Ranks) -> str:
    """What ranks are of, and their tests."""
    count = f"{len(ranks.table)} configurations, {ranks.recordings} recordings, "
    words = count + f"{ranks.fabrics} fabrics, critical difference {ranks.difference:.2f}"
    words += f", Friedman's p {ranks.p:.2g}" if np.isfinite(ranks.p) else ""
    return words + (f", left out {', '.join(ranks.left_out)}" if ranks.left_out else "")


def critical_difference(treatments: int, blocks: int) -> float:
    """The difference from which on two mean ranks are told apart (Nemenyi's test; Demsar 2006,
    section 3.2.2)."""
    quantile = stats.studentized_range.ppf(1 - SIGNIFICANCE, treatments, np.inf) / np.sqrt(2)
    return float(quantile * np.sqrt(treatments * (treatments + 1) / (6 * blocks)))
