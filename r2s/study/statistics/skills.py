"""Errors within the horizon beside floor and skill, over fabrics.

Skills are those of `r2s.study.rows.Row.skill`: of each run in each recording in which it is told.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from r2s.evaluation.crossed import CrossedMean, interval, units_needed
from r2s.evaluation.horizon import skill
from r2s.evaluation.statistics import SIGNIFICANCE
from r2s.study.configuration import ON_CLOTH, REFERENCES, Configuration
from r2s.study.rows import Row
from r2s.study.statistics.distances import mean_over_fabrics, with_references
from r2s.study.statistics.result_array import ResultArray, result_array, select


class Skill(NamedTuple):
    """The skill of a configuration in a motion, [-].

    - `mean`: over fabrics of the means over recordings and repeats; minus infinity where a run
      diverged. `low`, `high`: of its interval; NaN then, and for one fabric.
    - `median`: of all runs, where one that diverged is below any other.
    - `diverged`, `runs`: how many did, of those whose skill is told.
    - `told`, `judged`: recordings in which it is told, of how many.
    - `found`: what the interval is made of, of the runs that did not diverge.
    """

    mean: float
    low: float
    high: float
    median: float
    diverged: int
    runs: int
    told: int
    judged: int
    found: CrossedMean

    @property
    def needed(self) -> tuple[float, float, float]:
        """How many fabrics would tell this skill from the default's, zero (`units_needed`); NaN
        where runs diverged, and for one fabric."""
        if self.diverged or not self.runs:
            return np.nan, np.nan, np.nan
        return units_needed(self.found, self.found.mean, SIGNIFICANCE)


def with_floor(rows: Iterable[Row], metric: str) -> list[Row]:
    """The rows of a metric that stand beside a floor, of estimates (those of
    material points on the cloth, too), `REFERENCES` and defaults."""
    known = [row for row in rows if row.metric == metric and row.floor is not None]
    whose = [row for row in known if row.baseline in ("", "default", *REFERENCES, ON_CLOTH)]
    return [row for row in with_references(whose) if row.baseline in ("", "default")]


def deciding(rows: Iterable[Row], metric: str) -> tuple[list[Row], list[str]]:
    """Rows without those of a metric in recordings that tell no fabrics apart, and their names.

    These are recordings in which a skill is not told on some solver: the default is not clearly
    above the floor there, so that what is nearer is not better, and a ratio of errors says nothing.
    """
    rows = list(rows)
    own = [row for row in rows if row.metric == metric and row.floor is not None]
    judged = [row for row in own if row.baseline != "default" and np.isfinite(row.value)]
    untold = {row.recording for row in judged if row.skill is None}
    kept = [row for row in rows if row.metric != metric or row.recording not in untold]
    return kept, sorted(untold)


def skills(rows: Iterable[Row], motion: str) -> dict[Configuration, Skill]:
    """The skill of every configuration in a motion, from what `with_floor` returns."""
    rows = [row for row in rows if row.evaluated_on == motion]
    told = [replace(row, unit="-", value=row.skill) for row in rows if row.skill is not None]
    judged = _recordings(rows)
    results = result_array(told, told[0].metric if told else "")
    found = {}
    for configuration, recordings in judged.items():
        part = select(results, configuration.__eq__)
        found[configuration] = _skill(part, len(recordings))
    return found


def _recordings(rows: Iterable[Row]) -> dict[Configuration, set[str]]:
    found: dict[Configuration, set[str]] = {}
    for row in rows:
        if (configuration := row.configuration) is not None:
            found.setdefault(configuration, set()).add(row.recording)
    return found


def _skill(part: ResultArray, judged: int) -> Skill:
    if not part.present.any():
        nothing = CrossedMean(np.nan, 0, np.nan, 0.0, np.nan)
        return Skill(np.nan, np.nan, np.nan, np.nan, 0, 0, 0, judged, nothing)
    values, present, lost = part.values[0], part.present[0], int(part.diverged.sum())
    found = mean_over_fabrics(part, values)
    runs = np.where(np.isfinite(values), values, -np.inf)[present]
    mean, ends = found.mean, interval(found)
    if lost:
        mean, ends = -np.inf, (np.nan, np.nan)
    told = int(present.any(axis=1).sum())
    return Skill(mean, *ends, float(np.median(runs)), lost, len(runs), told, judged, found)


def mean_floor(rows: Iterable[Row], motion: str, configuration: Configuration) -> float:
    """The mean over fabrics of the means over recordings of the floor, [unit]; NaN without any."""
    theirs = [row for row in rows if _is_of(row, motion, configuration)]
    floors = [replace(row, value=np.nan if row.floor is None else row.floor) for row in theirs]
    if not floors:
        return np.nan
    results = result_array(floors, floors[0].metric)
    return mean_over_fabrics(results, results.values[0]).mean


class Draws(NamedTuple):
    """The least and the largest of a fabric's draws of a default, mean over fabrics: errors [unit],
    infinite where one diverged, and skills [-] beside the mean over all; NaN where none is told."""

    errors: tuple[float, float]
    skills: tuple[float, float]


def draws(rows: Iterable[Row], motion: str, configuration: Configuration) -> Draws:
    """The spread of a default fabric's draws in a motion: each fabric has draws of its own."""
    theirs = [row for row in rows if _is_of(row, motion, configuration)]
    drawn: dict[str, list[float]] = {}
    for row in theirs:
        if np.isfinite(row.value):  # as skills are told
            drawn.setdefault(row.recording, []).append(row.value)
    told = []
    for row in theirs:
        default = float(np.mean(drawn.get(row.recording, [np.nan])))
        value = skill(row.value, default, float(row.floor or 0))
        if not np.isnan(value):
            told.append(replace(row, value=value))
    return Draws(_span(theirs, np.inf), _span(told, -np.inf))


def _span(rows: list[Row], diverged: float) -> tuple[float, float]:
    """Means over fabrics of the least and the largest draw of each, which is the mean over its
    recordings; `diverged` where one is not finite."""
    values: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        values.setdefault(row.fabric, {}).setdefault(row.repeat, []).append(row.value)
    of_fabric = [
        [float(np.mean(each)) if np.isfinite(each).all() else diverged for each in own.values()]
        for own in values.values()
    ]
    if not of_fabric:
        return np.nan, np.nan
    least, largest = (float(np.mean([pick(own) for own in of_fabric])) for pick in (min, max))
    return least, largest


def _is_of(row: Row, motion: str, configuration: Configuration) -> bool:
    return row.evaluated_on == motion and row.configuration == configuration
