"""Tables of our distances, in millimetres: a line a column, a cell a motion, with intervals."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Integer

from r2s.study.statistics.panel import (
    APPROACHES,
    LEVEL,
    Panel,
    by_metric,
    by_motion,
    interval,
    make_panel,
    over_repeats,
    resamples,
)
from r2s.study.statistics.tables import MISSING, Row, Table, significant

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
OWN = "own"  # what a column was estimated from


class Means(NamedTuple):
    """Means [unit] over trajectories and repeats that did not diverge, with their interval."""

    mean: Float[np.ndarray, " column"]
    low: Float[np.ndarray, " column"]
    high: Float[np.ndarray, " column"]
    diverged: Integer[np.ndarray, " column"]
    runs: Integer[np.ndarray, " column"]


def means(panel: Panel) -> Means:
    """The mean of each column: first over repeats, then over trajectories.

    Runs that diverged have no distance: they are counted, not averaged.
    """
    every = _over_trajectories(over_repeats(panel, diverged=np.nan), np.ones(panel.values.shape[1]))
    drawn = np.array(
        [
            _over_trajectories(over_repeats(panel, weights, np.nan), weights.trajectory)
            for weights in resamples(panel)
        ]
    ).reshape(-1, len(panel.columns))
    ends = np.array([interval(samples) for samples in drawn.T]).reshape(-1, 2)
    runs = panel.present.sum(axis=(1, 2))
    lost = (panel.present & ~np.isfinite(panel.values)).sum(axis=(1, 2))
    return Means(every, ends[:, 0], ends[:, 1], lost, runs)


def _over_trajectories(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    known = weights * np.isfinite(values)
    total, count = (known * np.nan_to_num(values)).sum(axis=1), known.sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def distance_table(rows: Sequence[Row], metric: str) -> Table:
    """One metric: a line a column of the study, a cell a motion: mean and interval.

    Last comes what each was estimated from, "own"; last lines are what to compare with: default
    fabrics, estimates of another fabric, another trial. Metres are shown in millimetres.
    """
    rows = _with_references(rows)
    found = by_motion(make_panel(rows, metric))
    found[OWN] = make_panel(rows, metric, own=True)
    shown = {motion: _cells(panel) for motion, panel in found.items() if panel.columns}
    columns = dict.fromkeys(column for panel in found.values() for column in panel.columns)
    units = {panel.unit for panel in found.values() if panel.columns}
    unit = " [mm]" if units == {"m"} else ""
    lines = tuple(
        (column.label, *(cells.get(column, MISSING) for cells in shown.values()))
        for column in columns
    )
    return Table(
        ("column", *(motion + unit for motion in shown)),
        lines,
        f"{metric}{unit}: mean over recordings and repeats, {LEVEL:.0%} interval by a bootstrap "
        'over both, and how many runs diverged (not in the mean). "own": the recordings that a '
        "column was estimated from.",
    )


def _with_references(rows: Iterable[Row]) -> list[Row]:
    """Rows in which estimates of another fabric, and of another trial, are columns as well."""
    rows = list(rows)
    found = []
    for row in rows:
        name = APPROACHES.get(row.approach, row.approach)
        if row.baseline == "other_fabric":
            found.append(replace(row, baseline="", approach=f"{name} (of another fabric)"))
        elif row.baseline == "repeatability":
            found.append(replace(row, baseline="", approach="another trial"))
    return rows + found


def _cells(panel: Panel) -> dict[object, str]:
    found = means(panel)
    in_mm = panel.unit == "m"
    scale = 1e3 if in_mm else 1.0
    return {
        column: cell(scale * mean, scale * low, scale * high, diverged, runs, in_mm)
        for column, mean, low, high, diverged, runs in zip(
            panel.columns, *(numbers.tolist() for numbers in found), strict=True
        )
    }


def cell(mean: float, low: float, high: float, diverged: int, runs: int, in_mm: bool) -> str:
    """A mean, its interval where there is one, and how many of the runs diverged."""
    if diverged == runs:
        return "diverged" if runs else MISSING
    show = (lambda value: f"{value:.1f}") if in_mm else significant
    text = show(mean)
    if low < high:
        text += f" [{show(low)}, {show(high)}]"
    return text + (f" ({diverged} of {runs} diverged)" if diverged else "")


def distance_tables(rows: Iterable[Row]) -> dict[str, Table]:
    """The tables of all metrics in metres that there are."""
    rows_of = by_metric(rows)
    return {
        metric: distance_table(rows_of[metric], metric) for metric in METRICS if metric in rows_of
    }
