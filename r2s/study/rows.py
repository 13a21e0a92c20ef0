"""The results of a study as rows of one number each: `results.csv`."""

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from operator import attrgetter
from pathlib import Path

import numpy as np

from r2s.files import write_text
from r2s.study.configuration import ON_CLOTH, Configuration

# The values of Row.baseline, and what a table calls them.
BASELINES = {"": "estimate"} | {
    name: name.replace("_", " ")
    for name in ("default", "middle", "true", ON_CLOTH, "other_fabric", "repeatability")
}


@dataclass(frozen=True, slots=True)
class Row:
    """One number of an estimate on a recording.

    - `repeat`: tells apart estimates of one configuration: from other recordings, or other seeds.
    - `baseline`: "" for the estimate itself, else what it is compared with, see `BASELINES`;
      "on_cloth" for what an estimate on material points predicts on the cloth.
    - `unit`: SI, or "-" for a number without one. `value` is in that unit.
    - `floor`: what the recording itself is known to, in that unit. `horizon`: until when it tells
      fabrics apart, [s]. `skill`: see `r2s.evaluation.horizon`. None: not known, or not told.

    Raises `ValueError` for an unknown baseline.
    """

    approach: str
    solver: str
    estimated_from: str
    fabric: str
    repeat: str
    recording: str
    evaluated_on: str
    baseline: str
    metric: str
    unit: str
    value: float
    floor: float | None = None
    horizon: float | None = None
    skill: float | None = None

    def __post_init__(self) -> None:
        if self.baseline not in BASELINES:
            known = ", ".join(map(repr, BASELINES))
            raise ValueError(f"unknown baseline {self.baseline!r}, expected one of {known}")

    @property
    def configuration(self) -> Configuration | None:
        """What the row counts for; None for baselines other than the default fabric."""
        if self.baseline == "default":
            return Configuration("", self.solver, "")
        if self.baseline:
            return None
        return Configuration(self.approach, self.solver, self.estimated_from)


HEADER = tuple(field.name for field in fields(Row))
TEXTS = HEADER.index("value")  # columns before it are text
place_of = attrgetter(*HEADER[: HEADER.index("unit")])  # what one number alone may have


def write_rows(path: Path | str, rows: Iterable[Row]) -> None:
    """Write rows as CSV with `HEADER`, whole or not at all; an OSError names `path`.

    `read_rows` returns the same floats, NaN and infinities included.
    """

    # repr of the plain float: that of NumPy's scalars reads "np.float64(...)".
    def number(value: float | None) -> str:
        return "" if value is None else repr(float(value))

    lines = []
    for row in rows:
        numbers = row.value, row.floor, row.horizon, row.skill
        lines.append((*astuple(row)[:TEXTS], *(number(each) for each in numbers)))
    write_text(path, csv_text([HEADER, *lines]))


def read_rows(path: Path | str) -> list[Row]:
    """Read what `write_rows` wrote.

    Raises FileNotFoundError, or a ValueError that names the file and the line: another header,
    too few or too many cells, a value that is no number, an unknown baseline.
    """
    rows = []
    with open(path, newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        header = next(lines, [])
        if tuple(header) != HEADER:
            raise ValueError(f"{path}: expected the header {','.join(HEADER)}, found {header}")
        for cells in lines:
            where = f"{path}, line {lines.line_num}"
            if len(cells) != len(HEADER):
                raise ValueError(f"{where}: expected {len(HEADER)} cells, found {len(cells)}")
            try:
                value, *others = cells[TEXTS:]
                floor, horizon, skill = (float(each) if each else None for each in others)
                told = {"floor": floor, "horizon": horizon, "skill": skill}
                rows.append(Row(*cells[:TEXTS], value=float(value), **told))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from error
    return rows


def csv_text(lines: Iterable[Iterable[str]]) -> str:
    """Lines of cells as CSV, quoted where needed."""

    # Not csv.writer: with "\n" as the end of a line, it leaves a lone "\r" unquoted in some
    # versions of Python, where its own reader then ends the line.
    def cell(text: str) -> str:
        return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text

    return "".join(",".join(map(cell, line)) + "\n" for line in lines)


def by_metric(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each metric."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.metric, []).append(row)
    return found


def drop_undefined(rows: Iterable[Row]) -> tuple[list[Row], dict[str, int]]:
    """Leave out rows whose metric has no value though the run did not diverge.

    A run did not diverge where another of its metrics is finite; but what is judged within a
    horizon says nothing of a run that diverged after it, and a distance beside a floor is looked at
    in every frame, so where it has no value the run diverged, though others may not have seen it.
    Returns the other rows, and how many of each metric are left out.
    """
    rows = list(rows)
    run = attrgetter(*HEADER[: HEADER.index("metric")])
    whole = [row for row in rows if row.horizon is None or row.horizon == np.inf]
    finite = {run(row) for row in whole if np.isfinite(row.value)}
    kept, left_out = [], dict[str, int]()
    for row in rows:
        if np.isfinite(row.value) or run(row) not in finite or row.floor is not None:
            kept.append(row)
        else:
            left_out[row.metric] = left_out.get(row.metric, 0) + 1
    return kept, left_out
