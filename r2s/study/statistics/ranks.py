"""Which configuration is best more often: ranks within each trajectory, and whether they differ.

Distances of trajectories differ by more than those of configurations; ranks within a trajectory are
comparable. Demsar 2006, Statistical comparisons of classifiers over multiple data sets.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from r2s.evaluation.statistics import LEVEL, Friedman, critical_difference, friedman, interval
from r2s.study.configuration import Configuration
from r2s.study.statistics.result_array import ResultArray, mean_over_repeats, resamples, select
from r2s.study.tables import MISSING, Table, significant


class Ranks(NamedTuple):
    """Mean ranks, 1 the best, of the configurations that were judged on the same trajectories.

    - `low`, `high`: interval by a bootstrap over trajectories and repeats. Means of resampled
      repeats scatter more than those of all, so that intervals reach to the middle rather too far.
    - `first`: the share of trajectories in which a configuration is the best.
    - `trajectories`: how many count. `left_out`: configurations that lack most of them.
    - `by_trajectory`: Friedman's test of all but default fabrics with trajectories as blocks, which
      takes those of one fabric, with the same estimates, for independent. `by_fabric`: with
      fabrics as blocks.
    - `difference`: by which two mean ranks must differ to be told apart (Nemenyi), with
      trajectories as blocks.
    """

    configurations: tuple[Configuration, ...]
    mean: Float[np.ndarray, " configuration"]
    low: Float[np.ndarray, " configuration"]
    high: Float[np.ndarray, " configuration"]
    first: Float[np.ndarray, " configuration"]
    trajectories: int
    left_out: tuple[Configuration, ...]
    by_trajectory: Friedman
    by_fabric: Friedman
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
    drawn = [
        np.average(
            rankdata(mean_over_repeats(part, weights), axis=0), axis=1, weights=weights.trajectory
        )
        for weights in resamples(part)
    ]
    ends = np.array([interval(samples) for samples in np.array(drawn).T])
    of_fabric = np.stack([ranks[:, part.of_fabric(f)].mean(axis=1) for f in part.fabrics], axis=1)
    best = ranks == ranks.min(axis=0)
    estimates = [bool(configuration.approach) for configuration in part.configurations]
    return Ranks(
        configurations=part.configurations,
        mean=ranks.mean(axis=1),
        low=ends[:, 0],
        high=ends[:, 1],
        first=(best / best.sum(axis=0)).mean(axis=1),
        trajectories=len(part.trajectories),
        left_out=tuple(c for c in results.configurations if c not in wanted),
        by_trajectory=friedman(ranks[estimates]),
        by_fabric=friedman(of_fabric[estimates]),
        difference=critical_difference(len(part.configurations), len(part.trajectories)),
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
        f"{caption}: mean rank (1 is best), {LEVEL:.0%} interval, and how often the best of all. "
        f"{words}",
    )


def _cells(ranks: Ranks) -> dict[Configuration, str]:
    return {
        configuration: f"{mean:.2f} [{low:.2f}, {high:.2f}], {100 * first:.0f} %"
        for configuration, mean, low, high, first in zip(*ranks[:5], strict=True)
    }


def _tests(ranks: Ranks) -> str:
    """The tests in words."""
    words = [f"{len(ranks.configurations)} configurations, {ranks.trajectories} trajectories"]
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
        missing = ", ".join(configuration.label for configuration in ranks.left_out)
        words.append(f"left out, judged on less than half: {missing}")
    return "; ".join(words) + "."
