"""The results of a study as one long table with a number a row: `results.csv`.

Columns:

- `approach`, `solver`, `estimated_from`: the configuration; `fabric`; `repeat`: tells apart
  estimates of one configuration, from other recordings or other seeds.
- `recording`, `evaluated_on`: the recording that the prediction is compared with, and its motion.
- `baseline`: "" for an estimate, else what it is compared with: "default" (draws of the prior),
  "middle" (of the prior), "true" (fabric), "on_cloth" (what was estimated on points, predicted on
  the cloth), "other_fabric" (the estimate of one), "repeatability" (another trial).
- `metric`, `unit`, `value`: SI, or "-" for a number without a unit; NaN where a run diverged.
- `floor`: the accuracy of the recording itself, in that unit. `horizon`: until when it tells
  fabrics apart, [s]. `skill`: see `r2s.metrics.horizon`. NaN: not known.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s._util.files import write_text
from r2s.study.configuration import (
    MOTIONS,
    PAPER_CONFIGURATIONS,
    Configuration,
    as_configuration,
)

TEXTS = ("approach", "solver", "estimated_from", "fabric", "repeat", "recording", "evaluated_on",
         "baseline", "metric", "unit")  # fmt: skip
NUMBERS = ("value", "floor", "horizon", "skill")
COLUMNS = (*TEXTS, *NUMBERS)
PLACE = list(TEXTS[:-1])  # no two rows share these
RUN = PLACE[:-1]
CONFIGURATION = list(TEXTS[:3])
ESTIMATE, DEFAULT = "", "default"


def as_frame(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """A table of results from rows with the keys of `COLUMNS`; numbers may be missing."""
    frame = pd.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype({**dict.fromkeys(TEXTS, object), **dict.fromkeys(NUMBERS, float)})


def write_results(path: Path | str, results: pd.DataFrame) -> None:
    """Write a table of results as CSV, whole or not at all; an OSError names `path`."""
    write_text(path, results[list(COLUMNS)].to_csv(index=False, lineterminator="\n"))


def labelled(results: pd.DataFrame) -> pd.DataFrame:
    """Results with what analyses need besides.

    - `configuration`: the label of a configuration, a reference or the default, in the order in
      which tables show them: those of the paper first, the default last.
    - `movement`: what recordings of several fabrics have in common, as fabrics are moved alike.
    - `diverged`: whether the run did. `log`: of the value; NaN where it is not above zero.
    """
    columns = (results[name] for name in ("approach", "solver", "estimated_from", "baseline"))
    keys = list(zip(*columns, strict=True))
    named = {key: configuration_of(*key) for key in dict.fromkeys(keys)}
    order = dict.fromkeys(each.label for each in sorted(named.values(), key=_place))
    pairs = zip(results.recording, results.fabric, strict=True)
    return results.assign(
        configuration=pd.Categorical([named[key].label for key in keys], list(order), ordered=True),
        movement=[recording.replace(fabric, "") for recording, fabric in pairs],
        diverged=~np.isfinite(results.value),
        log=np.log(results.value.where(np.isfinite(results.value) & (results.value > 0))),
    )


def configuration_of(
    approach: str, solver: str, estimated_from: str, baseline: str
) -> Configuration:
    """What a row counts for; references and the default are configurations, too."""
    if baseline == DEFAULT:
        return Configuration("", solver, "")
    if baseline == "repeatability":
        return Configuration("another trial", solver, estimated_from)
    return as_configuration(Configuration(approach, solver, estimated_from), baseline)


def _place(configuration: Configuration) -> tuple:
    paper = dict(zip(PAPER_CONFIGURATIONS, range(99), strict=False))
    return paper.get(configuration, 99), not configuration.approach, configuration


def configurations(results: pd.DataFrame) -> list[Configuration]:
    """The configurations that have an estimate, in the order of `labelled`."""
    own = results[(results.baseline == ESTIMATE) & (results.approach != "")]
    found = own[CONFIGURATION].drop_duplicates().itertuples(index=False)
    return sorted((Configuration(*each) for each in found), key=_place)


def motions(results: pd.DataFrame) -> list[str]:
    """The motions that results are judged on, in the order of `MOTIONS`."""
    there = set(results.evaluated_on)
    return [motion for motion in MOTIONS if motion in there]


def without_undefined(results: pd.DataFrame) -> pd.DataFrame:
    """Leave out values that are not defined though the run did not diverge.

    A run did not diverge where another of its metrics is finite over the whole motion. A distance
    beside a floor is looked at in every frame: where it has no value, the run diverged.
    """
    finite = np.isfinite(results.value)
    is_whole = results.horizon.isna() | np.isinf(results.horizon)
    went_well = (finite & is_whole).groupby([results[name] for name in RUN]).transform("any")
    return results[finite | ~went_well | results.floor.notna()]


def fabrics_in_common(results: pd.DataFrame) -> list[str]:
    """The fabrics of which every configuration has an estimate; all, where none has all.

    Means over other fabrics cannot be compared.
    """
    own = results[(results.baseline == ESTIMATE) & (results.approach != "")]
    every = len(own[CONFIGURATION].drop_duplicates())
    counts = own[[*CONFIGURATION, "fabric"]].drop_duplicates().groupby("fabric").size()
    return list(counts.index[counts == every]) or list(dict.fromkeys(results.fabric))


def undecided(results: pd.DataFrame, metric: str) -> list[str]:
    """The recordings that do not discriminate between fabrics on some solver.

    The default is not clearly above the floor there, so no skill is known of some run, and what is
    nearer is not better.
    """
    judged = results[(results.metric == metric) & results.floor.notna()]
    judged = judged[(judged.baseline != DEFAULT) & np.isfinite(judged.value)]
    return sorted(set(judged[judged.skill.isna()].recording))
