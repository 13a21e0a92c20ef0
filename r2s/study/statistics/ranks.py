"""Which configuration is best more often: ranks within each trajectory, and whether they differ.

Distances of trajectories differ by more than those of configurations; ranks within a trajectory are
comparable. Demsar 2006, Statistical comparisons of classifiers over multiple data sets.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from r2s.evaluation.crossed import crossed_mean, interval
from r2s.evaluation.statistics import LEVEL, Friedman, critical_difference, friedman
from r2s.study.configuration import Configuration
from r2s.study.statistics.result_array import ResultArray, mean_over_repeats, select
from r2s.study.statistics.samples import by_movement, of_fabrics
from r2s.study.tables import MISSING, Table, significant


class Ranks(NamedTuple):
    """Mean ranks, 1 the best, of the configurations that were judged on the same trajectories.

    - `mean`: over fabrics, of their means over trajectories. `low`, `high`: its interval, for
      fabrics like these; NaN for one fabric.
    - `first`: the share of trajectories in which a configuration is the best.
    - `trajectories`, `fabrics`: how many count. `left_out`: configurations that lack most of them.
    - `test`: Friedman's test of all but default fabrics, with fabrics as blocks.
    - `difference`: by which two mean ranks must differ to be told apart (Nemenyi), with fabrics as
      blocks.
    """

    configurations: tuple[Configuration, ...]
    mean: Float[np.ndarray, " configuration"]
    low: Float[np.ndarray, " configuration"]
    high: Float[np.ndarray, " configuration"]
    first: Float[np.ndarray, " configuration"]
    trajectories: int
    fabrics: int
    left_out: tuple[Configuration, ...]
    test: Friedman
    difference: float


def rank(results: ResultArray) -> Ranks | None:
    """The ranks of configurations; None where fewer than two share a trajectory.

    Ranks are of means over repeats. A mean with a repeat that diverged is last, together with the
    others of that kind. Configurations that lack more than half of the trajectories are left out,
    and then trajectories that one of the others lacks.
    """
    there = np.asarray(results.present.any(axis=2))
    kept = there.mean(axis=1) >= 0.5 if there.size else np.zeros(len(there), bool)
    complete = np.asarray(there[kept].all(axis=0))
    wanted = {c for c, keep in zip(results.configurations, kept, strict=True) if keep}
    used = {t for t, keep in zip(results.trajectories, complete, strict=True) if keep}
    part = select(results, wanted.__contains__, used.__contains__)
    if len(part.configurations) < 2 or not part.trajectories:
        return None
    ranks = rankdata(mean_over_repeats(part), axis=0)
    of_fabric = of_fabrics(part, ranks)
    found = [
        crossed_mean(numbers, (by_movement(part, own),))
        for numbers, own in zip(of_fabric, ranks, strict=True)
    ]
    ends = np.clip([interval(each) for each in found], 1, len(ranks))
    best = ranks == ranks.min(axis=0)
    estimates = [bool(configuration.approach) for configuration in part.configurations]
    return Ranks(
        configurations=part.configurations,
        mean=of_fabric.mean(axis=1),
        low=ends[:, 0],
        high=ends[:, 1],
        first=(best / best.sum(axis=0)).mean(axis=1),
        trajectories=len(part.trajectories),
        fabrics=len(part.fabrics),
        left_out=tuple(c for c in results.configurations if c not in wanted),
        test=friedman(of_fabric[estimates]),
        difference=critical_difference(len(part.configurations), len(part.fabrics)),
    )


def rank_table(found: Mapping[str, Ranks], caption: str) -> Table:
    """Mean ranks by motion: a line a configuration, the best of the last motion first."""
    last = list(found.values())[-1]
    order = [last.configurations[i] for i in np.argsort(last.mean, kind="stable")]
    order += [c for ranks in found.values() for c in ranks.configurations if c not in order]
    shown = [_cells(ranks) for ranks in found.values()]
    words = " ".join(f"{motion.capitalize()}: {_tests(each)}" for motion, each in found.items())
    return Table(
        ("configuration", *found),
        tuple((c.label, *(cells.get(c, MISSING) for cells in shown)) for c in dict.fromkeys(order)),
        f"{caption}: mean rank (1 is best), {LEVEL:.0%} interval for fabrics like these, and how "
        "often the best of all. Tests of ranks are for these motions. "
        f"{words}",
    )


def _cells(ranks: Ranks) -> dict[Configuration, str]:
    return {
        configuration: f"{mean:.2f}{_ends(low, high)}, {100 * first:.0f} %"
        for configuration, mean, low, high, first in zip(*ranks[:5], strict=True)
    }


def _ends(low: float, high: float) -> str:
    return f" [{low:.2f}, {high:.2f}]" if np.isfinite(low) else ""


def _tests(ranks: Ranks) -> str:
    """The tests in words."""
    words = [
        f"{len(ranks.configurations)} configurations, {ranks.trajectories} trajectories, "
        f"{ranks.fabrics} fabrics"
    ]
    blocks = "Friedman's test with the fabrics as blocks"
    if np.isfinite(ranks.test.p):
        words.append(
            f"{blocks}: chi² = {significant(ranks.test.statistic)}, p = {ranks.test.p:.2g}"
        )
    else:
        words.append(f"{blocks} cannot be made")
    words.append(f"mean ranks differ from {ranks.difference:.2f} on (Nemenyi)")
    if ranks.left_out:
        missing = ", ".join(configuration.label for configuration in ranks.left_out)
        words.append(f"left out, judged on less than half: {missing}")
    return "; ".join(words) + "."
