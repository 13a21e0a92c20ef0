"""Columns of a CSV whose header says their units: read, checked, and brought to SI.

read_columns("pull.csv", {"extension": METRES, "force": NEWTONS})
"""

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
NEWTONS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665}
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
SHARES = {"-": 1.0, "%": 1e-2}
GRAMS = ("g", "kg", "grams", "kilograms")  # of mass: no force


class Columns(NamedTuple):
    """- `values`: in SI, column by column in the order in which they were asked for.
    - `lines`: of the file, where each sample stands.
    """

    values: Float[np.ndarray, "sample column"]
    lines: tuple[int, ...]


def read_columns(path: Path | str, columns: Mapping[str, Mapping[str, float]]) -> Columns:
    """Read some columns of a CSV with a header, its cells parted by commas, semicolons or tabs.

    `columns` has of each its name and the units that it may be in. The header says which, as in
    "time_s", "Force [N]" or "force (mN)". Other columns are passed over, and so are blank lines and
    lines that start with #.

    Raises FileNotFoundError, or a ValueError that names the file and the line: no such column or
    no unit, values that are no finite numbers, fewer than two samples.
    """
    path = Path(path)
    lines = read_lines(path)
    if not lines:
        raise ValueError(f"{path}: the log is empty")
    header = lines[0][1]
    places = [_column(path, header, name, units) for name, units in columns.items()]
    rows = []
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise ValueError(
                f"{path}: line {number} has {len(cells)} columns, the header {len(header)}: it is "
                "cut short, or decimal commas part the columns (write decimal points)"
            )
        rows.append([number_in(path, number, cells[index]) * unit for index, unit in places])
    if len(rows) < 2:
        raise ValueError(f"{path}: expected two samples or more, found {len(rows)}")
    return Columns(np.array(rows), tuple(number for number, _ in lines[1:]))


def header_of(path: Path | str) -> list[str]:
    """The cells of a CSV's header; none of an empty file."""
    lines = read_lines(Path(path))
    return lines[0][1] if lines else []


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """The lines of a CSV that hold something, with their numbers, as cells.

    Cells are parted by commas, semicolons or tabs; lines that begin with # are passed over. Raises
    FileNotFoundError, or a ValueError that names the file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text in UTF-8 ({error.reason}): export it again") from error
    kept = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not kept:
        return []
    delimiter = max(",;\t", key=kept[0][1].count)
    cells = csv.reader([line for _, line in kept], delimiter=delimiter, skipinitialspace=True)
    numbers = [number for number, _ in kept]
    try:
        cells = list(cells)
    except csv.Error as error:
        raise ValueError(f"{path}: no CSV: {error}") from error
    if len(cells) != len(numbers):
        raise ValueError(f"{path}: a quotation mark is not closed")
    return [(n, [c.strip() for c in row]) for n, row in zip(numbers, cells, strict=True)]


def _column(
    path: Path, header: list[str], name: str, units: Mapping[str, float]
) -> tuple[int, float]:
    """The index of a column, and its unit in SI."""
    unit_of = r"(?:[\s_]*[\[(]?\s*([\w%-]+)\s*[\])]?)?"
    pattern = re.compile(re.escape(name) + unit_of, re.IGNORECASE)
    found = [(i, match[1]) for i, cell in enumerate(header) if (match := pattern.fullmatch(cell))]
    if len(found) != 1:
        raise ValueError(
            f"{path}: expected one column {name!r} with its unit, such as "
            f"'{name}_{next(iter(units))}', found {len(found)} in {header}: rename it, or name "
            "the column that is meant"
        )
    index, unit = found[0]
    if unit in GRAMS and "N" in units:
        raise ValueError(
            f"{path}: {header[index]!r} is a mass: a force is in N, or in gf where a scale shows "
            "grams (1 gf = 9.80665 mN): name the column force_gf if it does"
        )
    if unit not in units:
        raise ValueError(
            f"{path}: the unit of {header[index]!r} is not known: write one of {', '.join(units)} "
            f"into the header, as in '{name} [{next(iter(units))}]'"
        )
    return index, units[unit]


def number_in(path: Path, line: int, cell: str, what: str = "a finite number") -> float:
    """The number in a cell; ValueError that names the file and the line when there is none."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{path}: line {line}: expected {what}, found {cell!r}: write a number")
    return value
