"""Means over fabrics with their intervals: errors within the horizon, floors and skills.

Conclusions are for fabrics like those of the study, so the fabrics are the sample: each has one
number, whatever the count of its recordings and estimates. All fabrics were moved alike, so what a
motion, or the number of an estimate, contributes is common to all of them.
"""

import numpy as np
import pandas as pd
from scipy.stats import norm

from r2s.metrics.horizon import skill
from r2s.metrics.statistics import LEVEL, CrossedMean, crossed_mean, interval
from r2s.study.configuration import ON_CLOTH

PLACES = ["fabric", "movement", "repeat"]


def crossed(values: pd.Series) -> CrossedMean:
    """The mean over fabrics of the means over recordings and repeats.

    `values`: indexed by `PLACES`; what is not finite does not count. The analysis of variance in
    `r2s.metrics.statistics` stands beside statsmodels' `MixedLM` because its tests at a level of
    5 % find 0 % in studies of two fabrics without an effect, where those of `MixedLM` find 18 %
    (four motions; deviations 0.2 between fabrics, 0.1 between motions and in the rest).
    """
    values = values[np.isfinite(values)]
    if values.empty:
        return crossed_mean(np.zeros(0))
    by_movement = values.groupby(["fabric", "movement"]).mean().unstack()
    by_repeat = values.groupby(["fabric", "repeat"]).mean().unstack()
    numbers = by_movement.mean(axis=1)
    return crossed_mean(numbers.to_numpy(), [by_movement.to_numpy(), by_repeat.to_numpy()])


def means(results: pd.DataFrame, column: str = "value") -> pd.DataFrame:
    """The mean of each configuration on each motion, from what `labelled` returns.

    Columns: `mean`; `low`, `high` of its interval; `median` of all runs; how many runs `diverged`,
    of how many `runs`. A run that diverged is worse than any other: its value is infinite, its
    skill minus infinity. The interval of a `value` is that of its logarithm, by the relative
    error, so that it has no end below zero.
    """
    rows = []
    for place, group in results.groupby(["configuration", "evaluated_on"], observed=True):
        worst = -np.inf if column == "skill" else np.inf
        values = group.set_index(PLACES)[column].where(~group.diverged.to_numpy(), worst)
        found = crossed(values)
        mean, (low, high) = found.mean, interval(found)
        if column != "skill" and mean > 0:
            reach = (high - low) / 2 / mean
            low, high = mean * np.exp(-reach), mean * np.exp(reach)
        if lost := int(group.diverged.sum()):
            mean, low, high = worst, np.nan, np.nan
        rows.append((*place, mean, low, high, float(np.median(values)), lost, len(values)))
    keys = ["configuration", "evaluated_on"]
    header = [*keys, "mean", "low", "high", "median", "diverged", "runs"]
    return pd.DataFrame(rows, columns=header).set_index(keys)


def with_skill(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Results with the skill of the rows of a metric that have a floor, beside the mean error of
    the default on the same solver in the same recording (`r2s.metrics.horizon.skill`).

    The mean is over the draws that did not diverge: one that did would end the skill of all.
    """
    own = results[(results.metric == metric) & results.floor.notna()]
    place = ["solver", "fabric", "recording"]
    drawn = own[own.baseline == "default"]
    finite = drawn.value.where(np.isfinite(drawn.value))
    default = finite.groupby([drawn[name] for name in place]).mean().to_dict()
    told = {
        row.Index: skill(row.value, default[key], row.floor)
        for row in own[own.baseline != "default"].itertuples()
        if (key := (row.solver, row.fabric, row.recording)) in default
    }
    return results.assign(skill=pd.Series(told, results.index, dtype=float))


def with_floor(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The rows of a metric that have a floor: of estimates, references and defaults."""
    whose = results.baseline.isin(("", "default", "true", "middle", ON_CLOTH))
    return results[(results.metric == metric) & results.floor.notna() & whose]


def skills(results: pd.DataFrame) -> pd.DataFrame:
    """The skill of each configuration on each motion, see `means`; from what `with_floor` returns.

    More columns: `known`, in how many recordings a skill is known, of how many `judged`; `floor`,
    its mean over fabrics.
    """
    keys = ["configuration", "evaluated_on"]
    groups = results.groupby(keys, observed=True)
    known = results[results.skill.notna()]
    of_fabric = results.groupby([*keys, "fabric", "movement"], observed=True).floor.mean()
    floor = of_fabric.groupby([*keys, "fabric"], observed=True).mean()
    columns = {
        "judged": groups.recording.nunique(),
        "floor": floor.groupby(keys, observed=True).mean(),
        "known": known.groupby(keys, observed=True).recording.nunique(),
    }
    found = pd.DataFrame(columns)
    found["known"] = found.known.fillna(0).astype(int)
    return found.join(means(known, "skill"))


def parameter_intervals(parameters: pd.DataFrame) -> pd.DataFrame:
    """Estimates [unit] with the ends of their intervals, from `r2s.study.results.parameters`.

    Standard errors are those of the logarithm for a logarithmic range.
    """
    reach = norm.ppf((1 + LEVEL) / 2) * parameters.standard_error
    value, is_log = parameters.value, parameters.is_log
    factor = np.exp(reach.where(is_log))
    low = (value / factor).where(is_log, value - reach)
    high = (value * factor).where(is_log, value + reach)
    columns = ["recording", "parameter", "unit", "value", "low", "high", "is_identifiable", "truth"]
    return parameters.assign(low=low, high=high)[columns]
