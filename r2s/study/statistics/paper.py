"""The tables of the study (Ru et al. 2025) beside ours, in its units.

Its numbers are not part of this package: `read_paper` reads them from a folder that the user has,
with `folding.csv`, `fling.csv` and `shaking.csv`. Their header is `metric,fabric` and then one
name a column, such as `diffcloud-diffsim-lifting`; `metric` is CD or HD.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.study.statistics.distances import cell
from r2s.study.statistics.panel import (
    MOTIONS,
    PAPER_COLUMNS,
    Column,
    Panel,
    by_metric,
    make_panel,
    over_repeats,
    select,
)
from r2s.study.statistics.tables import MISSING, Row, Table

CITED = "Ru et al. 2025, tables"
SOLVERS = {"diffsim": "cloth", "difftaichi": "points"}
METRICS = {"CD": "paper_chamfer", "HD": "paper_hausdorff"}
AVERAGE = "Average"

# By motion and metric, then column and fabric (named as our presets).
Paper = Mapping[tuple[str, str], Mapping[Column, Mapping[str, float]]]


def read_paper(folder: Path | str | None) -> Paper:
    """The study's three tables; none at all without a folder.

    Lines of averages are left out: they are made again from the others. Raises FileNotFoundError,
    or a ValueError that names the file and the line: another header, an unknown column, metric or
    fabric given twice, a cell that is missing or no positive number.
    """
    if folder is None:
        return {}
    return {
        (motion, metric): columns
        for motion in MOTIONS
        for metric, columns in _read(Path(folder) / f"{motion}.csv").items()
    }


def _read(path: Path) -> dict[str, dict[Column, dict[str, float]]]:
    found: dict[str, dict[Column, dict[str, float]]] = {}
    with open(path, newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        header = next(lines, [])
        if header[:2] != ["metric", "fabric"] or len(header) < 3:
            raise ValueError(f"{path}, line 1: expected metric,fabric,COLUMNS, found {header}")
        columns = [_column(path, name) for name in header[2:]]
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
            for column, text in zip(columns, cells[2:], strict=True):
                values = table.setdefault(column, {})
                if fabric in values:
                    raise ValueError(f"{where}: {cells[0]} of {cells[1]} is given twice")
                values[fabric] = _positive(where, text)
    return found


def _column(path: Path, name: str) -> Column:
    parts = name.split("-")
    if len(parts) != 3 or parts[1] not in SOLVERS:
        known = " or ".join(SOLVERS)
        raise ValueError(f"{path}, line 1: expected APPROACH-SIMULATOR-SCENARIO with {known}, "
                         f"found {name!r}")  # fmt: skip
    return Column(parts[0], SOLVERS[parts[1]], parts[2])


def _positive(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{where}: expected a number above zero, found {text!r}")
    return value


def average(paper: Paper, motion: str, metric: str, columns: Sequence[Column]) -> float:
    """The mean over fabrics and columns in the study's tables, [-]; NaN when one is not there."""
    table = paper.get((motion, metric), {})
    if not columns or any(column not in table for column in columns):
        return math.nan
    return float(np.mean([np.mean(list(table[column].values())) for column in columns]))


def beside_paper(rows: Sequence[Row], paper: Paper, motion: str, metric: str) -> Table:
    """One line a fabric, and their mean: each column of ours beside the same of the study.

    `metric`: paper_chamfer or paper_hausdorff. Ours: means over recordings and repeats that did
    not diverge, and how many did.
    """
    panel = make_panel(rows, metric, (motion,))
    theirs = paper.get((motion, metric), {})
    columns = (
        *(column for column in PAPER_COLUMNS if column in panel.columns or column in theirs),
        *(column for column in panel.columns if column not in PAPER_COLUMNS),
    )
    fabrics = dict.fromkeys(t.fabric for t in panel.trajectories)
    fabrics |= dict.fromkeys(fabric for values in theirs.values() for fabric in values)
    header, lines = ["fabric"], [[name.replace("_", " ")] for name in fabrics]
    foot = ["mean"]
    for column in columns:
        sides = {column.label: _ours(panel, column, list(fabrics))} if panel.columns else {}
        if column in theirs:
            sides[f"{column.label}, paper"] = _theirs(theirs[column], list(fabrics))
        for label, cells in sides.items():
            header.append(label)
            for line, text in zip([*lines, foot], cells, strict=True):
                line.append(text)
    kind = "Chamfer distance" if metric == METRICS["CD"] else "Hausdorff distance"
    cited = f"; paper: {CITED}" if theirs else ""
    return Table(
        tuple(header),
        tuple(map(tuple, [*lines, foot])),
        f"{kind} on {motion}, in the units of the paper [-]{cited}",
        foot=1,
    )


def _ours(panel: Panel, column: Column, fabrics: list[str]) -> list[str]:
    """A cell a fabric, and the mean of the fabrics."""
    part = select(panel, lambda c: c == column)
    shown, means = [], []
    for fabric in fabrics:
        one = select(part, trajectories=lambda t, fabric=fabric: t.fabric == fabric)
        values = over_repeats(one, diverged=np.nan)
        known = values[np.isfinite(values)]
        mean = float(known.mean()) if len(known) else math.nan
        shown.append(cell(mean, math.nan, math.nan, *_counts(one), in_mm=False))
        means += [mean] if one.present.any() else []
    known = [mean for mean in means if math.isfinite(mean)]
    mean = float(np.mean(known)) if known else math.nan
    return [*shown, cell(mean, math.nan, math.nan, *_counts(part), in_mm=False)]


def _theirs(values: Mapping[str, float], fabrics: list[str]) -> list[str]:
    # Three decimals, as they are printed.
    shown = [f"{values[fabric]:.3f}" if fabric in values else MISSING for fabric in fabrics]
    return [*shown, f"{np.mean(list(values.values())):.3f}"]


def _counts(panel: Panel) -> tuple[int, int]:
    lost = panel.present & ~np.isfinite(panel.values)
    return int(lost.sum()), int(panel.present.sum())


def paper_tables(rows: Sequence[Row], paper: Paper) -> dict[str, Table]:
    """The tables of all motions and both metrics for which we, or the study, have numbers."""
    found, rows_of = {}, by_metric(rows)
    for motion in MOTIONS:
        for metric in METRICS.values():
            table = beside_paper(rows_of.get(metric, []), paper, motion, metric)
            if len(table.header) > 1:
                found[f"{motion}_{metric}"] = table
    return found
