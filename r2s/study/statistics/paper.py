"""The tables of the paper (Ru et al. 2025) beside ours, in its units.

Its numbers are not part of this package: `read_paper` reads them from a folder that the user has,
with `folding.csv`, `fling.csv` and `shaking.csv`. Their header is `metric,fabric` and then one
name for each configuration, such as `diffcloud-diffsim-lifting`; `metric` is CD or HD.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.rows import Row, by_metric
from r2s.study.statistics.distances import cell, means
from r2s.study.statistics.result_array import (
    ResultArray,
    result_array,
    select,
)
from r2s.study.tables import MISSING, Table

CITED = "Ru et al. 2025, tables"
SOLVERS = {"diffsim": "cloth", "difftaichi": "points"}
METRICS = {"CD": "paper_chamfer", "HD": "paper_hausdorff"}
AVERAGE = "Average"

# Values by motion and metric, then by configuration and fabric (named as our presets).
Paper = Mapping[tuple[str, str], Mapping[Configuration, Mapping[str, float]]]


def read_paper(folder: Path | str | None) -> Paper:
    """Read the paper's three tables; the result is empty without a folder.

    Lines of averages are left out: they are made again from the others. Raises FileNotFoundError,
    or a ValueError that names the file and the line: another header, an unknown configuration,
    metric or fabric given twice, a cell that is missing or no positive number.
    """
    if folder is None:
        return {}
    return {
        (motion, metric): table
        for motion in MOTIONS
        for metric, table in _read(Path(folder) / f"{motion}.csv").items()
    }


def _read(path: Path) -> dict[str, dict[Configuration, dict[str, float]]]:
    found: dict[str, dict[Configuration, dict[str, float]]] = {}
    with open(path, newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        header = next(lines, [])
        if header[:2] != ["metric", "fabric"] or len(header) < 3:
            raise ValueError(f"{path}, line 1: expected metric,fabric,COLUMNS, found {header}")
        configurations = [_configuration(path, name) for name in header[2:]]
        for cells in lines:
            where = f"{path}, line {lines.line_num}"
            if len(cells) != len(header):
                raise ValueError(f"{where}: expected {len(header)} cells, found {len(cells)}")
            if cells[0] not in METRICS:
                raise ValueError(f"{where}: expected the metric CD or HD, found {cells[0]!r}")
            if cells[1] == AVERAGE:
                continue
            fabric = cells[1].strip().lower().replace(" ", "_")
            table = found.setdefault(METRICS[cells[0]], {})
            for configuration, text in zip(configurations, cells[2:], strict=True):
                values = table.setdefault(configuration, {})
                if fabric in values:
                    raise ValueError(f"{where}: {cells[0]} of {cells[1]} is given twice")
                values[fabric] = _positive(where, text)
    return found


def _configuration(path: Path, name: str) -> Configuration:
    parts = name.split("-")
    if len(parts) != 3 or parts[1] not in SOLVERS:
        known = " or ".join(SOLVERS)
        raise ValueError(f"{path}, line 1: expected APPROACH-SIMULATOR-SCENARIO with {known}, "
                         f"found {name!r}")  # fmt: skip
    return Configuration(parts[0], SOLVERS[parts[1]], parts[2])


def _positive(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{where}: expected a number above zero, found {text!r}")
    return value


def average(
    paper: Paper, motion: str, metric: str, configurations: Sequence[Configuration]
) -> float:
    """The mean over fabrics and configurations of the paper, [-]; NaN when one is not there."""
    table = paper.get((motion, metric), {})
    if not configurations or any(each not in table for each in configurations):
        return math.nan
    return float(np.mean([np.mean(list(table[each].values())) for each in configurations]))


def beside_paper(rows: Sequence[Row], paper: Paper, motion: str, metric: str) -> Table:
    """The table of one motion: each configuration of ours beside the same of the paper.

    There is a line for each fabric, and one for their mean. `metric` is paper_chamfer or
    paper_hausdorff. Ours are means over recordings and repeats; where some diverged medians, and
    how many did.
    """
    results = result_array(rows, metric, (motion,))
    theirs = paper.get((motion, metric), {})
    ours = results.configurations
    shown = [c for c in PAPER_CONFIGURATIONS if c in ours or c in theirs]
    shown += [c for c in ours if c not in PAPER_CONFIGURATIONS]
    fabrics = list(
        dict.fromkeys((*results.fabrics, *(f for each in theirs.values() for f in each)))
    )
    columns = {"fabric": [*(name.replace("_", " ") for name in fabrics), "mean"]}
    for configuration in shown:
        if ours:
            columns[configuration.label] = _ours(results, configuration, fabrics)
        if configuration in theirs:
            columns[f"{configuration.label}, paper"] = _theirs(theirs[configuration], fabrics)
    kind = "Chamfer distance" if metric == METRICS["CD"] else "Hausdorff distance"
    cited = f"; paper: {CITED}" if theirs else ""
    return Table(
        tuple(columns),
        tuple(zip(*columns.values(), strict=True)),
        f"{kind} on {motion}, in the units of the paper [-]{cited}",
        foot=1,
    )


def _ours(results: ResultArray, configuration: Configuration, fabrics: list[str]) -> list[str]:
    """A cell for each fabric, and one for the mean of the fabrics."""
    part = select(results, lambda c: c == configuration)
    parts = [select(part, trajectories=lambda t, name=name: t.fabric == name) for name in fabrics]
    return [_without_interval(each) for each in (*parts, part)]


def _without_interval(part: ResultArray) -> str:
    """The cell of one configuration."""
    if not part.present.any():
        return MISSING
    mean, _, _, median, diverged, runs = (each.item() for each in means(part))
    return cell(mean, math.nan, math.nan, median, diverged, runs, False)


def _theirs(values: Mapping[str, float], fabrics: list[str]) -> list[str]:
    # Three decimals, as they are printed.
    shown = [f"{values[fabric]:.3f}" if fabric in values else MISSING for fabric in fabrics]
    return [*shown, f"{np.mean(list(values.values())):.3f}"]


def paper_tables(rows: Sequence[Row], paper: Paper) -> dict[str, Table]:
    """The tables of all motions and both metrics for which we, or the paper, have numbers."""
    found, rows_of = {}, by_metric(rows)
    for motion in MOTIONS:
        for metric in METRICS.values():
            table = beside_paper(rows_of.get(metric, []), paper, motion, metric)
            if len(table.header) > 1:
                found[f"{motion}_{metric}"] = table
    return found
