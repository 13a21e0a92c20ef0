"""The results of a study as one long table, a number a row; errors, floors and skills from it.

Columns of `results.csv`:

- `approach`, `solver`, `estimated_from`: the configuration; `fabric`; `repeat`: the number of the
  estimate, from other recordings or another seed.
- `recording`, `evaluated_on`: the recording that a prediction is compared with, and its motion.
- `baseline`: "" for an estimate, else what it is compared with: "default" (samples of the prior),
  "middle" (median of the prior), "true" (fabric), "on_cloth" (estimated on points, predicted on the
  cloth), "other_fabric" (the estimate of one), "repeatability" (another trial).
- `metric`, `unit`, `value`: SI, or "-" for a number without a unit; NaN where a run diverged.
- `floor`: the accuracy of the recording itself, in that unit. `horizon`: the time up to which it
  discriminates between fabrics, [s]. `skill`: see `r2s.metrics.horizon`. NaN: not known.

Conclusions are about fabrics like those of the study, so the fabrics are the sample: each has one
number, however many recordings and estimates it has. All fabrics were moved alike, so the
contributions of a motion and of a repeat are common to all of them.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s._util.files import write_text
from r2s.metrics.horizon import skill
from r2s.metrics.statistics import CrossedMean, crossed_mean, interval
from r2s.study.configuration import (
    MOTIONS,
    ON_CLOTH,
    PAPER_CONFIGURATIONS,
    Configuration,
    as_configuration,
)

TEXTS = ("approach", "solver", "estimated_from", "fabric", "repeat", "recording", "evaluated_on",
         "baseline", "metric", "unit")  # fmt: skip
NUMBERS = ("value", "floor", "horizon", "skill")
COLUMNS = (*TEXTS, *NUMBERS)
PLACE = list(TEXTS[:-1])  # unique for each row
RUN = PLACE[:-1]
CONFIGURATION = list(TEXTS[:3])
ESTIMATE, DEFAULT = "", "default"
CELL = ["configuration", "evaluated_on"]  # of a table of means


def as_frame(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """A table of results from rows with the keys of `COLUMNS`; numbers may be missing."""
    frame = pd.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype({**dict.fromkeys(TEXTS, object), **dict.fromkeys(NUMBERS, float)})


def write_results(path: Path | str, results: pd.DataFrame) -> None:
    """Write a table of results as CSV, completely or not at all; an OSError names `path`."""
    write_text(path, results[list(COLUMNS)].to_csv(index=False, lineterminator="\n"))


def labelled(results: pd.DataFrame) -> pd.DataFrame:
    """Results with further columns for the analysis.

    - `configuration`: the label of a configuration, a reference or the default, ordered: those of
      the paper first, the default last.
    - `movement`: the part of the recording's name that is common to all fabrics.
    - `diverged`: whether the run did. `log`: of the value; NaN where it is not above zero.
    """
    keys = list(results[[*CONFIGURATION, "baseline"]].itertuples(index=False, name=None))
    named = {key: _configuration_of(*key) for key in dict.fromkeys(keys)}
    order = list(dict.fromkeys(each.label for each in sorted(named.values(), key=_order)))
    pairs = zip(results.recording, results.fabric, strict=True)
    finite = results.value.where(np.isfinite(results.value) & (results.value > 0))
    return results.assign(
        configuration=pd.Categorical([named[key].label for key in keys], order, ordered=True),
        movement=[recording.replace(fabric, "") for recording, fabric in pairs],
        diverged=~np.isfinite(results.value),
        log=np.log(finite),
    )


def _configuration_of(
    approach: str, solver: str, estimated_from: str, baseline: str
) -> Configuration:
    if baseline == DEFAULT:
        return Configuration("", solver, "")
    if baseline == "repeatability":
        return Configuration("another trial", solver, estimated_from)
    return as_configuration(Configuration(approach, solver, estimated_from), baseline)


def _order(configuration: Configuration) -> tuple:
    order = [*PAPER_CONFIGURATIONS, configuration]
    return order.index(configuration), not configuration.approach, configuration


def configurations(results: pd.DataFrame) -> list[Configuration]:
    """The configurations that have an estimate, in the order of `labelled`."""
    own = results[(results.baseline == ESTIMATE) & (results.approach != "")]
    found = own[CONFIGURATION].drop_duplicates().itertuples(index=False)
    return sorted((Configuration(*each) for each in found), key=_order)


def motions(results: pd.DataFrame) -> list[str]:
    """The motions of results, in the order of `MOTIONS`."""
    there = set(results.evaluated_on)
    return [motion for motion in MOTIONS if motion in there]


def without_undefined(results: pd.DataFrame) -> pd.DataFrame:
    """Leave out values that are undefined although the run did not diverge.

    A run did not diverge where another of its metrics is finite over the whole motion. A distance
    with a floor depends on every frame: where it has no value, the run diverged.
    """
    finite = np.isfinite(results.value)
    is_whole = results.horizon.isna() | np.isinf(results.horizon)
    went_well = (finite & is_whole).groupby([results[name] for name in RUN]).transform("any")
    return results[finite | ~went_well | results.floor.notna()]


def fabrics_in_common(results: pd.DataFrame) -> list[str]:
    """The fabrics of which every configuration has an estimate, as means over different fabrics
    cannot be compared; all, where none has all."""
    own = results[(results.baseline == ESTIMATE) & (results.approach != "")]
    every = len(own[CONFIGURATION].drop_duplicates())
    counts = own[[*CONFIGURATION, "fabric"]].drop_duplicates().groupby("fabric").size()
    return list(counts.index[counts == every]) or list(dict.fromkeys(results.fabric))


def undecided(results: pd.DataFrame, metric: str) -> list[str]:
    """The recordings that do not discriminate between fabrics on some solver: the default is not
    clearly above the floor, so a skill is not known, and a smaller error is not better."""
    judged = results[(results.metric == metric) & results.floor.notna()]
    judged = judged[(judged.baseline != DEFAULT) & np.isfinite(judged.value)]
    return sorted(set(judged[judged.skill.isna()].recording))


def with_skill(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Results with the skill of the rows of a metric that have a floor, against the mean error of
    the default on the same solver in the same recording (`r2s.metrics.horizon.skill`).

    The mean is over the samples that did not diverge.
    """
    own = results[(results.metric == metric) & results.floor.notna()]
    place = ["solver", "fabric", "recording"]
    drawn = own[own.baseline == DEFAULT]
    finite = drawn.value.where(np.isfinite(drawn.value))
    default = finite.groupby([drawn[name] for name in place]).mean().to_dict()
    skills = {
        row.Index: skill(row.value, default[key], row.floor)
        for row in own[own.baseline != DEFAULT].itertuples()
        if (key := (row.solver, row.fabric, row.recording)) in default
    }
    return results.assign(skill=pd.Series(skills, results.index, dtype=float))


def with_floor(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The rows of a metric that have a floor: of estimates, references and defaults."""
    whose = results.baseline.isin((ESTIMATE, DEFAULT, "true", "middle", ON_CLOTH))
    return results[(results.metric == metric) & results.floor.notna() & whose]


def crossed(values: pd.Series) -> CrossedMean:
    """The mean over fabrics of the means over recordings and repeats; infinite values do not count.

    `values`: indexed by fabric, movement and repeat. The analysis of variance of
    `r2s.metrics.statistics` is used instead of statsmodels' `MixedLM`: in studies of two fabrics
    without an effect, tests at a level of 5 % find 0 %, those of `MixedLM` 18 % (four motions;
    deviations 0.2 between fabrics, 0.1 between motions and in the rest).
    """
    values = values[np.isfinite(values)]
    if values.empty:
        return crossed_mean(np.zeros(0))
    by_movement = values.groupby(["fabric", "movement"]).mean().unstack()
    by_repeat = values.groupby(["fabric", "repeat"]).mean().unstack()
    numbers = by_movement.mean(axis=1)
    return crossed_mean(numbers.to_numpy(), [by_movement.to_numpy(), by_repeat.to_numpy()])


def means(results: pd.DataFrame, column: str = "value") -> pd.DataFrame:
    """The mean of each configuration on each motion, from `labelled` results.

    Columns: `mean`; `low`, `high` of its interval; `median` of all runs; how many runs `diverged`,
    of how many `runs`. A run that diverged has an infinite value, and a skill of minus infinity.
    The interval of a `value` is that of its logarithm, by the relative error, so that it stays
    above zero.
    """
    rows = []
    for place, group in results.groupby(CELL, observed=True):
        worst = -np.inf if column == "skill" else np.inf
        values = group.set_index(["fabric", "movement", "repeat"])[column]
        values = values.where(~group.diverged.to_numpy(), worst)
        found = crossed(values)
        mean, (low, high) = found.mean, interval(found)
        if column != "skill" and mean > 0:
            reach = (high - low) / 2 / mean
            low, high = mean * np.exp(-reach), mean * np.exp(reach)
        if lost := int(group.diverged.sum()):
            mean, low, high = worst, np.nan, np.nan
        rows.append((*place, mean, low, high, float(np.median(values)), lost, len(values)))
    header = [*CELL, "mean", "low", "high", "median", "diverged", "runs"]
    return pd.DataFrame(rows, columns=header).set_index(CELL)


def skills(results: pd.DataFrame) -> pd.DataFrame:
    """The skill of each configuration on each motion, see `means`; from `with_floor`.

    Further columns: `known`, in how many recordings a skill is known, of how many `judged`;
    `floor`, its mean over fabrics.
    """
    groups = results.groupby(CELL, observed=True)
    known = results[results.skill.notna()]
    of_fabric = results.groupby([*CELL, "fabric", "movement"], observed=True).floor.mean()
    floor = of_fabric.groupby([*CELL, "fabric"], observed=True).mean()
    columns = {
        "judged": groups.recording.nunique(),
        "floor": floor.groupby(CELL, observed=True).mean(),
        "known": known.groupby(CELL, observed=True).recording.nunique(),
    }
    found = pd.DataFrame(columns)
    found["known"] = found.known.fillna(0).astype(int)
    return found.join(means(known, "skill"))
