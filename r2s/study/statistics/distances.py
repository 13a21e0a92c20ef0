"""Mean distances with intervals, and their tables: a line a configuration, a cell a motion."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer

from r2s.evaluation.crossed import CrossedMean, crossed_mean, interval
from r2s.evaluation.statistics import LEVEL
from r2s.study.configuration import Configuration, as_configuration
from r2s.study.rows import Row, by_metric
from r2s.study.statistics.result_array import (
    ResultArray,
    by_motion,
    result_array,
)
from r2s.study.statistics.samples import by_movement, finite_mean, of_fabrics
from r2s.study.tables import MISSING, Table, significant

METRICS = (
    "surface",
    "chamfer_real_to_sim",
    "chamfer_sim_to_real",
    "chamfer",
    "hausdorff",
    "chamfer_real_to_sim_cropped",
    "chamfer_sim_to_real_cropped",
    "chamfer_cropped",
    "hausdorff_cropped",
)
OWN = "own"  # what a configuration was estimated from


class Means(NamedTuple):
    """Mean distances [unit], over fabrics of the means over their trajectories and repeats.

    - `mean`, `low`, `high`: with their interval; NaN where a run diverged, the interval also where
      there is one fabric.
    - `median`: of all runs, where one that diverged is larger than any other.
    - `diverged`, `runs`: how many did, of how many.
    """

    mean: Float[np.ndarray, " configuration"]
    low: Float[np.ndarray, " configuration"]
    high: Float[np.ndarray, " configuration"]
    median: Float[np.ndarray, " configuration"]
    diverged: Integer[np.ndarray, " configuration"]
    runs: Integer[np.ndarray, " configuration"]


def means(results: ResultArray) -> Means:
    """The mean of each configuration.

    Intervals are for the mean over all fabrics of which these are a sample, on such motions and
    with such estimates (`r2s.evaluation.crossed`); they are made on the logarithm of the mean, by
    its relative error, so that they have no end below zero.
    """
    diverged, runs = results.diverged.sum(axis=(1, 2)), results.present.sum(axis=(1, 2))
    found = np.full((3, len(results.configurations)), np.nan)
    for i in np.flatnonzero((diverged == 0) & (runs > 0)):
        found[:, i] = _mean(results, results.values[i])
    worst = np.where(results.diverged, np.inf, results.values)
    medians = [
        float(np.median(values[there])) if there.any() else np.nan
        for values, there in zip(worst, results.present, strict=True)
    ]
    mean, low, high = found
    return Means(mean, low, high, np.array(medians), diverged, runs)


def mean_over_fabrics(
    results: ResultArray, values: Float[np.ndarray, "trajectory repeat"]
) -> CrossedMean:
    """The mean of one configuration over fabrics, of the means over trajectories and repeats."""
    values = np.where(np.isfinite(values), values, np.nan)
    of_trajectory = finite_mean(values, 1)
    numbers = of_fabrics(results, of_trajectory)
    kept = np.isfinite(numbers)
    tables = by_movement(results, of_trajectory), of_fabrics(results, values.T).T
    return crossed_mean(numbers[kept], [table[kept] for table in tables])


def _mean(
    results: ResultArray, values: Float[np.ndarray, "trajectory repeat"]
) -> tuple[float, float, float]:
    """The mean of one configuration, and its interval."""
    found = mean_over_fabrics(results, values)
    if found.mean <= 0:  # all of it is zero
        return found.mean, *interval(found)
    relative = found._replace(
        mean=np.log(found.mean),
        spread=found.spread / found.mean,
        shared=found.shared / found.mean**2,
    )
    low, high = interval(relative)
    return found.mean, float(np.exp(low)), float(np.exp(high))


def in_common(rows: Iterable[Row]) -> tuple[list[Row], dict[str, list[Row]]]:
    """The rows of fabrics of which every configuration has an estimate, and those of each other.

    Means over other fabrics are not compared. Where no fabric has all, all count as the first.
    """
    rows = list(rows)
    having: dict[str, set[Configuration]] = {}
    for row in rows:
        if row.approach and (configuration := row.configuration) is not None:
            having.setdefault(row.fabric, set()).add(configuration)
    every = set().union(*having.values())
    whole = {fabric for fabric, own in having.items() if own == every}
    if not whole:
        return rows, {}
    others: dict[str, list[Row]] = {}
    for row in rows:
        if row.fabric not in whole:
            others.setdefault(row.fabric, []).append(row)
    return [row for row in rows if row.fabric in whole], others


def distance_tables(rows: Iterable[Row]) -> dict[str, Table]:
    """The tables of all metrics in metres that there are."""
    rows_of = by_metric(rows)
    return {
        metric: distance_table(rows_of[metric], metric) for metric in METRICS if metric in rows_of
    }


def distance_table(rows: Sequence[Row], metric: str) -> Table:
    """The table of one metric: a line a configuration, a cell a motion with mean and interval.

    The last column, "own", is what each was estimated from. The last lines are what to compare
    with: default fabrics, and what `with_references` adds. Metres are
    shown in millimetres.
    """
    rows = with_references(rows)
    found = by_motion(result_array(rows, metric))
    found[OWN] = result_array(rows, metric, own=True)
    found = {motion: results for motion, results in found.items() if results.configurations}
    shown = {motion: cells_of(results) for motion, results in found.items()}
    lines = dict.fromkeys(c for results in found.values() for c in results.configurations)
    unit = " [mm]" if {results.unit for results in found.values()} == {"m"} else ""
    return Table(
        ("configuration", *(motion + unit for motion in shown)),
        tuple((c.label, *(cells.get(c, MISSING) for cells in shown.values())) for c in lines),
        f"{metric}{unit}: mean over fabrics of the means over recordings and repeats, and "
        f"{LEVEL:.0%} interval for fabrics like these (Student's t: the fabrics are the sample). "
        "Where runs diverged there is no mean: how many, and the median of all, with those that "
        'diverged above any other. "own": the recordings that a configuration was estimated from.'
        + (" Frames before the horizon, where one is known." if metric == METRICS[0] else ""),
    )


def with_references(rows: Iterable[Row]) -> list[Row]:
    """Rows in which `REFERENCES`, estimates of another fabric, those on material points as the
    cloth predicts them, and another trial are configurations as well."""
    rows = list(rows)
    found = []
    for row in rows:
        if row.baseline == "repeatability":
            found.append(replace(row, baseline="", approach="another trial"))
        elif row.baseline not in ("", "default"):
            own = Configuration(row.approach, row.solver, row.estimated_from)
            named = as_configuration(own, row.baseline)._asdict()
            found.append(replace(row, baseline="", **named))
    return rows + found


def cells_of(results: ResultArray) -> dict[Configuration, str]:
    """The cell of each configuration, see `cell`; metres in millimetres."""
    in_mm = results.unit == "m"
    scale = 1e3 if in_mm else 1.0
    found = means(results)
    lengths = (scale * np.array(found[:4])).T.tolist()
    counts = zip(found.diverged.tolist(), found.runs.tolist(), strict=True)
    return {
        configuration: cell(mean, low, high, median, *lost, in_mm)
        for configuration, (mean, low, high, median), lost in zip(
            results.configurations, lengths, counts, strict=True
        )
    }


def cell(
    mean: float, low: float, high: float, median: float, diverged: int, runs: int, in_mm: bool
) -> str:
    """A mean and its interval where there is one; where runs diverged how many, and the median."""
    if diverged == runs:
        return "diverged" if runs else MISSING
    write = millimetres if in_mm else significant
    text, *ends, middle = (write(x) for x in (mean, low, high, median))
    if diverged:
        lost = f"{diverged} of {runs} diverged"
        return f"median {middle} ({lost})" if np.isfinite(median) else lost
    return f"{text} [{', '.join(ends)}]" if low < high else text


def millimetres(length: float) -> str:
    """A length [mm] to a tenth of a millimetre; below one to a hundredth."""
    return f"{length:.1f}" if abs(length) >= 0.995 or not np.isfinite(length) else f"{length:.2f}"
