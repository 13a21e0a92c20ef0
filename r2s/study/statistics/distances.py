"""Mean distances with intervals, and their tables: a line a configuration, a cell a motion."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer

from r2s.evaluation.statistics import LEVEL, interval
from r2s.study.configuration import APPROACHES
from r2s.study.rows import Row, by_metric
from r2s.study.statistics.result_array import (
    ResultArray,
    by_motion,
    mean_over_repeats,
    resamples,
    result_array,
    safe_ratio,
)
from r2s.study.tables import MISSING, Table, significant

METRICS = (
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
    """Means [unit] over trajectories and repeats that did not diverge, with their interval."""

    mean: Float[np.ndarray, " configuration"]
    low: Float[np.ndarray, " configuration"]
    high: Float[np.ndarray, " configuration"]
    diverged: Integer[np.ndarray, " configuration"]
    runs: Integer[np.ndarray, " configuration"]


def means(results: ResultArray) -> Means:
    """The mean of each configuration: first over repeats, then over trajectories.

    Runs that diverged have no distance: they are counted, not averaged.
    """
    of_all = mean_over_repeats(results, diverged=np.nan)
    drawn = [
        _over_trajectories(mean_over_repeats(results, weights, np.nan), weights.trajectory)
        for weights in resamples(results)
    ]
    samples = np.array(drawn).reshape(-1, len(results.configurations))
    ends = np.array([interval(each) for each in samples.T]).reshape(-1, 2)
    return Means(
        _over_trajectories(of_all, np.ones(of_all.shape[1])),
        ends[:, 0],
        ends[:, 1],
        results.diverged.sum(axis=(1, 2)),
        results.present.sum(axis=(1, 2)),
    )


def _over_trajectories(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    known = weights * np.isfinite(values)
    return safe_ratio((known * np.nan_to_num(values)).sum(axis=1), known.sum(axis=1))


def distance_tables(rows: Iterable[Row]) -> dict[str, Table]:
    """The tables of all metrics in metres that there are."""
    rows_of = by_metric(rows)
    return {
        metric: distance_table(rows_of[metric], metric) for metric in METRICS if metric in rows_of
    }


def distance_table(rows: Sequence[Row], metric: str) -> Table:
    """The table of one metric: a line a configuration, a cell a motion with mean and interval.

    The last column, "own", is what each was estimated from. The last lines are what to compare
    with: default fabrics, estimates of another fabric, another trial. Metres are shown in
    millimetres.
    """
    rows = _with_references(rows)
    found = by_motion(result_array(rows, metric))
    found[OWN] = result_array(rows, metric, own=True)
    found = {motion: results for motion, results in found.items() if results.configurations}
    shown = {motion: _cells(results) for motion, results in found.items()}
    lines = dict.fromkeys(c for results in found.values() for c in results.configurations)
    unit = " [mm]" if {results.unit for results in found.values()} == {"m"} else ""
    return Table(
        ("configuration", *(motion + unit for motion in shown)),
        tuple((c.label, *(cells.get(c, MISSING) for cells in shown.values())) for c in lines),
        f"{metric}{unit}: mean over recordings and repeats, {LEVEL:.0%} interval by a bootstrap "
        'over both, and how many runs diverged (not in the mean). "own": the recordings that a '
        "configuration was estimated from.",
    )


def _with_references(rows: Iterable[Row]) -> list[Row]:
    """Rows in which estimates of another fabric, and another trial, are configurations as well."""
    rows = list(rows)
    found = []
    for row in rows:
        name = APPROACHES.get(row.approach, row.approach)
        if row.baseline == "other_fabric":
            found.append(replace(row, baseline="", approach=f"{name} (of another fabric)"))
        elif row.baseline == "repeatability":
            found.append(replace(row, baseline="", approach="another trial"))
    return rows + found


def _cells(results: ResultArray) -> dict[object, str]:
    in_mm = results.unit == "m"
    scale = 1e3 if in_mm else 1.0
    numbers = zip(*(part.tolist() for part in means(results)), strict=True)
    return {
        configuration: cell(scale * mean, scale * low, scale * high, diverged, runs, in_mm)
        for configuration, (mean, low, high, diverged, runs) in zip(
            results.configurations, numbers, strict=True
        )
    }


def cell(mean: float, low: float, high: float, diverged: int, runs: int, in_mm: bool) -> str:
    """A mean, its interval where there is one, and how many of the runs diverged."""
    if diverged == runs:
        return "diverged" if runs else MISSING
    text, *ends = (f"{x:.1f}" if in_mm else significant(x) for x in (mean, low, high))
    if low < high:
        text += f" [{', '.join(ends)}]"
    return text + (f" ({diverged} of {runs} diverged)" if diverged else "")
