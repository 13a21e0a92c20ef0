"""Comparisons: which of two sides has the smaller distances, tested over fabrics; and ranks.

A comparison has one number a fabric, the mean logarithm of the ratio of two distances, above zero
where the hypothesis is right; intervals and tests are Student's t over fabrics. A run that diverged
has no distance: nothing is concluded in favour of a side of which one did.

Distances differ more between recordings than between configurations; ranks within a recording are
comparable. Demsar 2006, Statistical comparisons of classifiers over multiple data sets.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from statsmodels.stats.multitest import multipletests

from r2s.metrics.statistics import (
    SIGNIFICANCE,
    CrossedMean,
    crossed_mean,
    interval,
    p_value,
    units_needed,
)
from r2s.study.configuration import ON_CLOTH
from r2s.study.results import DEFAULT, ESTIMATE, motions

MARGIN = 0.05  # an interval of the ratio within 1 +- this says that there is no difference
HOLDS, HOLDS_NOT, UNKNOWN = "holds", "does not hold", "undecided"
NOTHING = CrossedMean(np.nan, 0, np.nan, 0.0, np.nan)


class Comparison(NamedTuple):
    """One test.

    - `effect`: the mean over fabrics of the logarithm of the ratio (of what `words` say, where it
      is no ratio), above zero where the hypothesis is right.
    - `agreeing`: in how many fabrics it is above zero.
    - `diverged`: runs that did, of the side that should be smaller, and of the larger.
    - `paper`: the two averages in the paper's tables, [-]; NaN: none.
    - `lacking`: why there is no test, or "".
    """

    words: str
    effect: CrossedMean = NOTHING
    agreeing: int = 0
    diverged: tuple[int, int] = (0, 0)
    is_ratio: bool = True
    paper: tuple[float, float] = (np.nan, np.nan)
    lacking: str = ""


def compare(
    words: str, results: pd.DataFrame, smaller: Sequence[str], larger: Sequence[str]
) -> Comparison:
    """Compare configurations over the recordings that they share; of several on a side the
    geometric mean counts.

    `results`: labelled, of one metric. `smaller`, `larger`: labels of the configurations that are
    expected to have the smaller and the larger distances.
    """
    sides = [*dict.fromkeys((*smaller, *larger))]
    part = results[results.configuration.isin(sides)]
    part = part.assign(configuration=part.configuration.astype(str))
    if missing := [label for label in sides if not (part.configuration == label).any()]:
        return Comparison(words, lacking=f"no rows of {', '.join(missing)}")
    counts = part.groupby("recording").configuration.transform("nunique")
    part = part[counts == len(sides)]
    if part.empty:
        return Comparison(words, lacking="nothing that both were judged on")
    first, second = (
        int(part[part.configuration.isin(side)].diverged.sum()) for side in (smaller, larger)
    )
    place = ["fabric", "movement"]
    part = part.assign(alone=part.groupby(["configuration", *place]).log.transform("size") == 1)
    wide = part.pivot(index=[*place, "repeat"], columns="configuration", values=["log", "alone"])
    logs, alone = wide["log"].astype(float), wide["alone"].fillna(False).astype(bool)
    of_recording = logs.groupby(place).mean()
    # a configuration that ran once is compared with every repeat of the other side
    ran_once = alone.groupby(place).transform("any")
    logs = logs.where(~ran_once, logs.groupby(place).transform("mean"))

    def apart(table: pd.DataFrame) -> pd.Series:
        means = [table[list(side)].mean(axis=1, skipna=False) for side in (larger, smaller)]
        return means[0] - means[1]

    by_movement = apart(of_recording).unstack()
    by_repeat = apart(logs).groupby(["fabric", "repeat"]).mean().unstack()
    return compared(words, by_movement.mean(axis=1), [by_movement, by_repeat], (first, second))


def compared(
    words: str,
    numbers: pd.Series,
    tables: Iterable[pd.DataFrame] = (),
    diverged: tuple[int, int] = (0, 0),
    is_ratio: bool = True,
) -> Comparison:
    """The comparison of numbers by fabric; `tables`: these by fabric and a factor that all share.

    Fabrics without a number (NaN) do not count.
    """
    numbers = numbers[np.isfinite(numbers)]
    if numbers.empty:
        why = "all of it diverged" if sum(diverged) else "nothing that both were judged on"
        return Comparison(words, diverged=diverged, lacking=why)
    arrays = [table.reindex(numbers.index).to_numpy(float) for table in tables]
    effect = crossed_mean(numbers.to_numpy(float), arrays)
    return Comparison(words, effect, int((numbers > 0).sum()), diverged, is_ratio)


def judge(comparisons: Iterable[tuple[str, Comparison]]) -> pd.DataFrame:
    """The answer to each comparison of each conclusion, after Holm's correction for all of them.

    A comparison holds where p is below `SIGNIFICANCE` in favour of it. It does not hold where p is
    against it, or where the interval of the ratio lies within `MARGIN` of 1. Columns: `conclusion`,
    `comparison`, `answer`, `lacking`, `ratio` with `low` and `high`, `p`, `p_holm`, `agreeing` of
    `fabrics`; `needed`, `fewest`, `most`: where there is no answer, the number of fabrics that
    would show a ratio like this, at least one as far from 1 as `MARGIN`; `diverged_smaller`,
    `diverged_larger`, `paper_smaller`, `paper_larger`.
    """
    pairs = list(comparisons)
    p = np.array([p_value(comparison.effect) for _, comparison in pairs])
    corrected, known = np.full(len(p), np.nan), np.isfinite(p)
    if known.any():
        corrected[known] = multipletests(p[known], method="holm")[1]
    level = SIGNIFICANCE / max(1, int(known.sum()))
    rows = []
    for (conclusion, comparison), own, holm in zip(pairs, p, corrected, strict=True):
        effect, needed = comparison.effect, (np.nan,) * 3
        ratio, low, high = np.exp((effect.mean, *interval(effect)))
        if not comparison.is_ratio:
            ratio, low, high = (np.nan,) * 3
        answer = _answer(comparison, low, high, holm)
        if answer == UNKNOWN and not comparison.lacking:
            needed = units_needed(effect, max(abs(effect.mean), np.log1p(MARGIN)), level)
        row = {
            "conclusion": conclusion,
            "comparison": comparison.words,
            "answer": answer,
            "lacking": comparison.lacking,
            "ratio": ratio,
            "low": low,
            "high": high,
            "p": own,
            "p_holm": holm,
            "agreeing": comparison.agreeing,
            "fabrics": effect.units,
            **dict(zip(("needed", "fewest", "most"), needed, strict=True)),
            **dict(zip(("diverged_smaller", "diverged_larger"), comparison.diverged, strict=True)),
            **dict(zip(("paper_smaller", "paper_larger"), comparison.paper, strict=True)),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _answer(comparison: Comparison, low: float, high: float, p: float) -> str:
    if comparison.lacking:
        return UNKNOWN
    if 1 / (1 + MARGIN) < low and high < 1 + MARGIN and not any(comparison.diverged):
        return HOLDS_NOT
    is_favoured = comparison.effect.mean > 0
    if p < SIGNIFICANCE and not comparison.diverged[0 if is_favoured else 1]:
        return HOLDS if is_favoured else HOLDS_NOT
    return UNKNOWN


def answers(judged: pd.DataFrame) -> dict[str, str]:
    """The answer to each conclusion: it holds where all its comparisons hold, and does not as soon
    as one of them does not."""
    by_conclusion = {}
    for conclusion, own in judged.groupby("conclusion", sort=False).answer:
        decided = HOLDS if (own == HOLDS).all() else UNKNOWN
        by_conclusion[conclusion] = HOLDS_NOT if (own == HOLDS_NOT).any() else decided
    return by_conclusion


def learned(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Whether the errors of each configuration (`conclusion`) on each motion (`comparison`) are
    below those of the prior mean on the same solver, in the recordings that have a skill.

    This test, and not the skill against samples, says what a recording adds to the prior.
    """
    known = results[(results.metric == metric) & results.skill.notna()]
    pairs = []
    for motion in motions(known):
        part = known[known.evaluated_on == motion]
        whose = part[["configuration", "solver", "baseline"]].drop_duplicates()
        middles = whose[whose.baseline == "middle"].set_index("solver").configuration.to_dict()
        for label, solver, baseline in whose.sort_values("configuration").itertuples(index=False):
            if baseline in (ESTIMATE, "true", ON_CLOTH) and solver in middles:
                pairs.append((str(label), compare(motion, part, [label], [middles[solver]])))
    return judge(pairs)


class Ranks(NamedTuple):
    """Mean ranks, 1 the best, of the configurations that have the same recordings.

    - `table`: by configuration `mean` over fabrics, `low` and `high` of its interval, and `first`,
      the share of recordings in which it is the best.
    - `p`: of Friedman's test of all but default fabrics, with fabrics as blocks; NaN for fewer than
      three configurations or two fabrics.
    - `words`: the sample, the critical difference of two mean ranks, p, and what is left out.
    """

    table: pd.DataFrame
    p: float
    words: str


def rank(results: pd.DataFrame) -> Ranks | None:
    """The ranks by one metric of estimates and defaults, from labelled results; None where fewer
    than two share a recording.

    Ranks are of means over repeats; a mean with a repeat that diverged is last. Configurations that
    lack more than half of the recordings are left out, then recordings that another one lacks.
    """
    own = results[results.baseline.isin((ESTIMATE, DEFAULT))]
    own = own.assign(value=own.value.where(~own.diverged, np.inf))
    place = ["fabric", "movement"]
    means = own.groupby([*place, "configuration"], observed=True).value.mean().unstack()
    is_kept = means.notna().mean() >= 0.5
    left_out = ", ".join(map(str, means.columns[~is_kept]))
    means = means.loc[:, is_kept].dropna()
    if len(means.columns) < 2 or means.empty:
        return None
    ranks = means.rank(axis=1)
    of_fabric = ranks.groupby("fabric").mean()
    ends = [
        interval(crossed_mean(of_fabric[label].to_numpy(), [ranks[label].unstack().to_numpy()]))
        for label in ranks.columns
    ]
    low, high = np.clip(np.array(ends).T, 1, len(ranks.columns))
    is_best = ranks.eq(ranks.min(axis=1), axis=0)
    first = is_best.div(is_best.sum(axis=1), axis=0).mean()
    table = pd.DataFrame({"mean": of_fabric.mean(), "low": low, "high": high, "first": first})
    defaults = set(own[own.baseline == DEFAULT].configuration)
    tested = of_fabric.loc[:, ~of_fabric.columns.isin(defaults)].T.to_numpy()
    can_test = len(tested) > 2 and len(of_fabric) > 1 and np.ptp(tested, axis=0).any()
    p = float(stats.friedmanchisquare(*tested).pvalue) if can_test else np.nan
    difference = critical_difference(len(table), len(of_fabric))
    words = f"{len(table)} configurations, {len(means)} recordings, {len(of_fabric)} fabrics, "
    words += f"critical difference {difference:.2f}"
    words += f", Friedman's p {p:.2g}" if np.isfinite(p) else ""
    words += f", left out {left_out}" if left_out else ""
    return Ranks(table.sort_values("mean", kind="stable"), p, words)


def critical_difference(treatments: int, blocks: int) -> float:
    """The least significant difference of two mean ranks (Nemenyi's test; Demsar 2006, section
    3.2.2)."""
    quantile = stats.studentized_range.ppf(1 - SIGNIFICANCE, treatments, np.inf) / np.sqrt(2)
    return float(quantile * np.sqrt(treatments * (treatments + 1) / (6 * blocks)))
