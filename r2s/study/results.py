"""The results of a study as one long table, a number a row; errors, floors and skills from it.

Columns of `results.csv`:

- `approach`, `solver`, `estimated_from`: the configuration; `fabric`; `repeat`: the number of the
  estimate, from other recordings or another seed.
- `recording`, `evaluated_on`: the recording that a prediction is compared with, and its motion.
- `baseline`: "" for an estimate, else what it is compared with: "default" (samples of the prior),
  "middle" (median of the prior), "true" (fabric), "on_cloth" (estimated on points, predicted on the
  cloth).
- `metric`, `unit`, `value`: SI, or "-" for a number without a unit; NaN where a run diverged.
- `floor`: the accuracy of the recording itself, in that unit. `horizon`: the time up to which it
  discriminates between fabrics, [s]. `skill`: see `r2s.metrics.horizon`. NaN: not known.

Conclusions are about fabrics like those of the study, so the fabrics are the sample: each has one
number, however many recordings and estimates it has. All fabrics were moved alike, so the
contributions of a motion and of a repeat are common to all of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2s._util.extras import require
from r2s.estimation.default_spaces import law_of, with_law
from r2s.estimation.method import default_space
from r2s.materials.parameters import Range
from r2s.metrics.horizon import skill
from r2s.metrics.prediction_error import UNITS
from r2s.metrics.statistics import CrossedMean, crossed_mean, interval
from r2s.study.configuration import (
    MOTIONS,
    ON_CLOTH,
    PAPER_CONFIGURATIONS,
    Configuration,
    as_configuration,
)
from r2s.study.ensembles import SURFACE, judged_errors, judged_motions
from r2s.study.estimates import EstimateTask, read_estimate
from r2s.study.evaluations import EvaluationTask, read_predictions
from r2s.study.recordings import SyntheticRecording, true_fabric
from r2s.study.tasks import with_dependencies

for module in ("pandas", "statsmodels", "plotly", "jinja2"):
    require(module, "study", "the report of a study")
import pandas as pd  # noqa: E402

TEXTS = ("approach", "solver", "estimated_from", "fabric", "repeat", "recording", "evaluated_on",
         "baseline", "metric", "unit")  # fmt: skip
NUMBERS = ("value", "floor", "horizon", "skill")
COLUMNS = (*TEXTS, *NUMBERS)
PLACE = list(TEXTS[:-1])  # unique for each row
RUN = PLACE[:-1]
CONFIGURATION = list(TEXTS[:3])
ESTIMATE, DEFAULT = "", "default"
CELL = ["configuration", "evaluated_on"]  # of a table of means
FACTORS = ["fabric", "movement", "repeat"]  # of a mean over fabrics
PARAMETERS = ("solver", "recording", "parameter", "unit", "value", "low", "high",
              "posterior_over_prior", "truth")  # fmt: skip


def as_frame(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """A table of results from rows with the keys of `COLUMNS`; numbers may be missing."""
    frame = pd.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype({**dict.fromkeys(TEXTS, object), **dict.fromkeys(NUMBERS, float)})


def labelled(results: pd.DataFrame) -> pd.DataFrame:
    """Results with further columns for the analysis.

    - `configuration`: the label of a configuration, a reference or the default, ordered: those of
      the paper first, the default last.
    - `movement`: the part of the recording's name that is common to all fabrics.
    - `diverged`: whether the run did. `log`: of the value; NaN where it is not above zero.
    """
    keys = list(results[[*CONFIGURATION, "baseline"]].itertuples(index=False, name=None))
    names = {key: as_configuration(Configuration(*key[:3]), key[3]) for key in dict.fromkeys(keys)}
    order = list(dict.fromkeys(named.label for named in sorted(names.values(), key=_order)))
    pairs = zip(results.recording, results.fabric, strict=True)
    finite = results.value.where(np.isfinite(results.value) & (results.value > 0))
    return results.assign(
        configuration=pd.Categorical([names[key].label for key in keys], order, ordered=True),
        movement=[recording.replace(fabric, "") for recording, fabric in pairs],
        diverged=~np.isfinite(results.value),
        log=np.log(finite),
    )


def _order(configuration: Configuration) -> tuple:
    order = [*PAPER_CONFIGURATIONS, configuration]
    return order.index(configuration), not configuration.approach, configuration


def configurations(results: pd.DataFrame) -> list[Configuration]:
    """The configurations that have an estimate, in the order of `labelled`."""
    own = results[results.baseline == ESTIMATE]
    rows = own[CONFIGURATION].drop_duplicates().itertuples(index=False)
    return sorted((Configuration(*row) for row in rows), key=_order)


def motions(results: pd.DataFrame) -> list[str]:
    """The motions of results, in the order of `MOTIONS`."""
    return [motion for motion in MOTIONS if (results.evaluated_on == motion).any()]


def without_undefined(results: pd.DataFrame) -> pd.DataFrame:
    """Leave out values that are undefined although the run did not diverge: another of its metrics
    is finite over the whole motion. A distance with a floor depends on every frame."""
    finite = np.isfinite(results.value)
    is_whole = results.horizon.isna() | np.isinf(results.horizon)
    went_well = (finite & is_whole).groupby([results[name] for name in RUN]).transform("any")
    return results[finite | ~went_well | results.floor.notna()]


def fabrics_in_common(results: pd.DataFrame) -> list[str]:
    """The fabrics of which every configuration has an estimate, as means over different fabrics
    cannot be compared; all, where none has all."""
    own = results[results.baseline == ESTIMATE]
    every = len(own[CONFIGURATION].drop_duplicates())
    counts = own[[*CONFIGURATION, "fabric"]].drop_duplicates().groupby("fabric").size()
    return list(counts.index[counts == every]) or list(dict.fromkeys(results.fabric))


def undecided(results: pd.DataFrame, metric: str) -> list[str]:
    """The recordings in which the default is not clearly above the floor on some solver: a skill is
    not known, and a smaller error is not better."""
    judged = results[(results.metric == metric) & results.floor.notna()]
    judged = judged[(judged.baseline != DEFAULT) & np.isfinite(judged.value)]
    return sorted(set(judged[judged.skill.isna()].recording))


def with_skill(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Results with the skill of the rows of a metric that have a floor, against the mean error of
    the samples of the default that did not diverge, on the same solver in the same recording."""
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
        values = group.set_index(FACTORS)[column]
        values = values.where(~group.diverged.to_numpy(), worst)
        mean_over_fabrics = crossed(values)
        mean, (low, high) = mean_over_fabrics.mean, interval(mean_over_fabrics)
        if column != "skill" and mean > 0:
            reach = (high - low) / 2 / mean
            low, high = mean * np.exp(-reach), mean * np.exp(reach)
        if diverged := int(group.diverged.sum()):
            mean, low, high = worst, np.nan, np.nan
        rows.append((*place, mean, low, high, float(np.median(values)), diverged, len(values)))
    header = [*CELL, "mean", "low", "high", "median", "diverged", "runs"]
    return pd.DataFrame(rows, columns=header).set_index(CELL).astype(float)


def skills(results: pd.DataFrame) -> pd.DataFrame:
    """The skill of each configuration on each motion, see `means`; from `with_floor`.

    Further columns: `known`, in how many recordings a skill is known, of how many `judged`;
    `floor`, its mean.
    """
    known = results[results.skill.notna()]
    groups, of_known = (part.groupby(CELL, observed=True) for part in (results, known))
    table = groups.agg(judged=("recording", "nunique"), floor=("floor", "mean"))
    table["known"] = of_known.recording.nunique().reindex(table.index, fill_value=0)
    return table.join(means(known, "skill"))


def collect(tasks: Sequence[EvaluationTask], folder: Path) -> pd.DataFrame:
    """The results of all finished tasks (see above)."""
    known = judged_motions(tasks, folder)
    rows: list[dict[str, Any]] = []
    for task in tasks:
        if not task.is_made(folder):
            continue
        predictions = read_predictions(task, folder)
        for source in task.recordings:
            place = {
                **task.configuration._asdict(),
                "fabric": task.fabric,
                "repeat": task.repeat,
                "recording": source.name,
                "evaluated_on": task.scenario,
                "baseline": task.baseline,
            }
            prediction = predictions[source.name]
            measured = [
                {"metric": name, "unit": UNITS.get(name, "m"), "value": value}
                for name, value in prediction.metrics.items()
            ]
            if source in known:  # which say more of the surface
                measured = [row for row in measured if row["metric"] != SURFACE]
                measured += judged_errors(source, prediction, task.shape, known[source], folder)
            rows += [place | row for row in measured]
    # trials may share a recording and its references
    return with_skill(as_frame(rows).drop_duplicates(PLACE, ignore_index=True), SURFACE)


def estimates_made(tasks: Iterable[EvaluationTask], folder: Path) -> list[EstimateTask]:
    """The finished estimates that tasks depend on."""
    needed = with_dependencies(tasks)
    return [task for task in needed if isinstance(task, EstimateTask) and task.is_made(folder)]


def parameters(tasks: Iterable[EvaluationTask], folder: Path) -> pd.DataFrame:
    """The estimated parameters, a line each, with `PARAMETERS`; `low` and `high` [unit] are those
    of the 90 % interval."""
    rows = []
    for task in estimates_made(tasks, folder):
        estimate = read_estimate(task, folder)
        if estimate is None:
            continue
        truth = true_values(task, estimate.ranges)
        numbers = estimate.values, *estimate.intervals.T, estimate.narrowing, truth
        columns = [np.asarray(column).tolist() for column in numbers]
        for bound, *own in zip(estimate.ranges, *columns, strict=True):
            rows.append((task.solver, task.name, bound.name, bound.unit, *own))
    return pd.DataFrame(rows, columns=list(PARAMETERS))


def true_values(task: EstimateTask, ranges: Sequence[Range]) -> np.ndarray:
    """The parameters [unit of the range] of a synthetic recording's fabric, of constant ones those
    at small strain; NaN for other recordings, and for multipliers of an assumed fabric."""
    source = task.sources[0]
    if (
        not isinstance(source, SyntheticRecording)
        or source.truth.materials
        or task.solver != "cloth"
    ):
        return np.full(len(ranges), np.nan)
    law = law_of(ranges)
    space = with_law(default_space("cloth", task.density), law)
    values = space.values(space.to_unit(true_fabric(task.fabric, law, source.truth)))
    known = {bound.name: float(v) for bound, v in zip(space.ranges, values, strict=True)}
    return np.array([known.get(bound.name, np.nan) for bound in ranges])
