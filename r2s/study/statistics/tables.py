"""Results as rows of one number each, and the tables that people read."""

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from r2s.fabrics.parameters import Range
from r2s.files import write_text

# The values of Row.baseline, and what a table calls them.
BASELINES = {"": "estimate"} | {
    name: name.replace("_", " ") for name in ("default", "other_fabric", "repeatability")
}
MISSING = "-"


@dataclass(frozen=True, slots=True)
class Row:
    """One number of an estimate on a recording. ValueError unless `baseline` is in BASELINES."""

    approach: str
    solver: str
    estimated_from: str
    fabric: str
    repeat: str  # which of several estimates alike: of other recordings, or another seed
    recording: str
    evaluated_on: str
    baseline: str  # "" for the estimate itself
    metric: str
    unit: str  # SI, "-" without one
    value: float  # [unit]

    def __post_init__(self) -> None:
        if self.baseline not in BASELINES:
            known = ", ".join(map(repr, BASELINES))
            raise ValueError(f"unknown baseline {self.baseline!r}, expected one of {known}")


COLUMNS = tuple(field.name for field in fields(Row))


@dataclass(frozen=True)
class Table:
    """Text in lines of as many cells as the header, else ValueError.

    The last `foot` lines sum up the others: they stay at the end when the table is sorted.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str
    foot: int = 0

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.header):
                raise ValueError(f"line {i} has {len(row)} cells, the header {len(self.header)}")
        if not 0 <= self.foot <= len(self.rows):
            raise ValueError(f"foot is {self.foot}, but there are {len(self.rows)} lines")


def write_rows(path: Path | str, rows: Iterable[Row]) -> None:
    """Write rows as CSV with the header COLUMNS, whole or not at all; OSError names `path`.

    Values are written such that `read_rows` returns the same floats, NaN and infinities included.
    """
    # repr of the plain float: that of NumPy's scalars reads "np.float64(...)".
    lines = [(*astuple(row)[:-1], repr(float(row.value))) for row in rows]
    write_text(path, _csv([COLUMNS, *lines]))


def read_rows(path: Path | str) -> list[Row]:
    """Read what `write_rows` wrote.

    Raises FileNotFoundError, or a ValueError that names the file and the line: another header,
    too few or too many cells, a value that is no number, an unknown baseline.
    """
    rows = []
    with open(path, newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        header = next(lines, [])
        if tuple(header) != COLUMNS:
            raise ValueError(f"{path}: expected the header {','.join(COLUMNS)}, found {header}")
        for cells in lines:
            where = f"{path}, line {lines.line_num}"
            if len(cells) != len(COLUMNS):
                raise ValueError(f"{where}: expected {len(COLUMNS)} cells, found {len(cells)}")
            try:
                rows.append(Row(*cells[:-1], value=float(cells[-1])))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from error
    return rows


def pivot(rows: Iterable[Row], metric: str, evaluated_on: str) -> Table:
    """One line a recording: the estimate beside what it is compared with; last their means.

    Of `rows`, those of `metric` and `evaluated_on` count, recordings in the order in which they
    first come. Lengths (unit "m") are shown in mm with one decimal, others with three significant
    digits. A cell without a row is "-"; means are over the recordings present, and not finite if
    one of these is not. Raises ValueError when no row counts, when units differ, and when two rows
    are for one cell, as of two approaches or solvers: choose among these first.
    """
    rows = list(rows)
    chosen = [row for row in rows if (row.metric, row.evaluated_on) == (metric, evaluated_on)]
    units = {row.unit for row in chosen}
    if not chosen:
        known = sorted({(row.metric, row.evaluated_on) for row in rows})
        raise ValueError(f"no rows of {metric!r} on {evaluated_on!r}; there are {known}")
    if len(units) > 1:
        raise ValueError(f"{metric} on {evaluated_on}: several units: {sorted(units)}")
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for row in chosen:
        line = cells.setdefault((row.fabric, row.recording), {})
        if row.baseline in line:
            what = f"{metric} on {evaluated_on}, {BASELINES[row.baseline]}, {row.recording}"
            raise ValueError(f"several values for one cell: {what}")
        line[row.baseline] = row.value
    show, unit = (
        (lambda value: f"{value * 1e3:.1f}", "mm") if units == {"m"} else (significant, units.pop())
    )
    means = {
        key: float(np.mean(present))
        for key in BASELINES
        if (present := [line[key] for line in cells.values() if key in line])
    }
    lines = [(*names, *_numbers(line, show)) for names, line in cells.items()]
    return Table(
        header=("fabric", "recording", *(_with_unit(name, unit) for name in BASELINES.values())),
        rows=(*lines, ("mean", "", *_numbers(means, show))),
        caption=f"{_with_unit(metric, unit)} on {evaluated_on}",
        foot=1,
    )


def parameter_table(
    entries: Sequence[tuple[str, tuple[Range, ...], Any, Any, Any, Any]],
    caption: str = "Parameters: value ± standard deviation",
) -> Table:
    """What was estimated from each recording, a column a parameter.

    Each entry: the name of the recording, its ranges, and of the shape (dim,) in their order: the
    values [unit of the range]; the standard deviations, relative for a logarithmic range and else
    [unit]; booleans, whether the recording determined the parameter; the true values [unit], or
    None for all or NaN for one where unknown. Ranges may differ between entries: a parameter that
    one lacks is "-". Raises ValueError, naming the recording, for other shapes.
    """
    names = list(dict.fromkeys(bound.name for _, ranges, *_ in entries for bound in ranges))
    lines = []
    for recording, ranges, values, deviations, determined, truth in entries:
        truth = np.full(len(ranges), np.nan) if truth is None else truth
        numbers = [np.asarray(array, float) for array in (values, deviations, determined, truth)]
        if any(array.shape != (len(ranges),) for array in numbers):
            found = [array.shape for array in numbers]
            raise ValueError(f"{recording}: expected {len(ranges)} of each number, found {found}")
        cells = zip(ranges, *(array.tolist() for array in numbers), strict=True)
        shown = {bound.name: _parameter(bound, *rest) for bound, *rest in cells}
        lines.append((recording, *(shown.get(name, MISSING) for name in names)))
    return Table(("recording", *names), tuple(lines), caption)


def significant(value: float) -> str:
    """A number with three significant digits, without an exponent from 1e-4 up to 1e6."""
    rounded = float(f"{value:.3g}")
    if 1e3 <= abs(rounded) < 1e6:  # "g" would write 1.23e+03
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".removesuffix(".")


def markdown(table: Table) -> str:
    """The table in Markdown, the caption above."""

    rows = [table.header, ("---",) * len(table.header), *table.rows]
    lines = [[" ".join(cell.replace("|", r"\|").split()) for cell in row] for row in rows]
    return f"{table.caption}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def csv_text(table: Table) -> str:
    """The table as CSV, without the caption."""
    return _csv([table.header, *table.rows])


def latex(table: Table) -> str:
    r"""The table as a LaTeX `table`, which needs \\usepackage{booktabs}; all text is escaped.

    Columns whose cells are numbers, but for the lines at the foot, are set to the right.
    """
    end = len(table.rows) - table.foot
    bodies = [row for row in table.rows[:end]] or list(table.rows)
    sides = "".join(
        "r" if bodies and all(_is_number(row[i]) for row in bodies) else "l"
        for i in range(len(table.header))
    )
    line = lambda cells: " & ".join(map(_latex_text, cells)) + r" \\" + "\n"
    foot = "\\midrule\n" + "".join(map(line, table.rows[end:])) if table.foot else ""
    return (
        "\\begin{table}\n\\centering\n"
        f"\\caption{{{_latex_text(table.caption)}}}\n\\begin{{tabular}}{{{sides}}}\n\\toprule\n"
        f"{line(table.header)}\\midrule\n{''.join(map(line, table.rows[:end]))}{foot}"
        "\\bottomrule\n\\end{tabular}\n\\end{table}\n"
    )


def publish(folder: Path | str, name: str, table: Table) -> Table:
    """Write a table as `name`.csv, .md and .tex into a folder, which is made; returns it."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for ending, text in (("csv", csv_text), ("md", markdown), ("tex", latex)):
        write_text(folder / f"{name}.{ending}", text(table))
    return table


def html(table: Table) -> str:
    """The table as an HTML fragment of class "sortable", which the script of a report sorts."""

    def lines(rows: Iterable[tuple[str, ...]]) -> str:
        return "".join(f"<tr>{''.join(map(cell, row))}</tr>\n" for row in rows)

    def cell(text: str) -> str:
        return f"<td{' class=number' if _is_number(text) else ''}>{escape(text)}</td>"

    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.header)
    end = len(table.rows) - table.foot
    return (
        f'<table class="sortable">\n<caption>{escape(table.caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{lines(table.rows[:end])}</tbody>\n"
        f"<tfoot>\n{lines(table.rows[end:])}</tfoot>\n</table>\n"
    )


LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    '"': "''", "±": r"$\pm$", "×": r"$\times$", "²": r"$^2$",
    "[": "{[}",  # at the start of a line it would be an option of the line before
    **{character: "\\" + character for character in "&%$#_"},
}  # fmt: skip


def _latex_text(text: str) -> str:
    return "".join(LATEX.get(character, character) for character in " ".join(text.split()))


def _csv(lines: Iterable[Iterable[str]]) -> str:
    # Not csv.writer: with "\n" as the end of a line, it leaves a lone "\r" unquoted in some
    # versions of Python, where its own reader then ends the line.
    def cell(text: str) -> str:
        return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text

    return "".join(",".join(map(cell, line)) + "\n" for line in lines)


def _numbers(line: dict[str, float], show: Callable[[float], str]) -> tuple[str, ...]:
    return tuple(show(line[key]) if key in line else MISSING for key in BASELINES)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit not in ("", "-") else name


def _parameter(
    bound: Range, value: float, deviation: float, determined: float, truth: float
) -> str:
    unit = "" if bound.unit in ("", "-") else f" {bound.unit}"
    if determined:
        text = _plus_minus(value, deviation * (abs(value) if bound.log else 1)) + unit
    else:
        text = f"not determined (best fit {significant(value)}{unit})"
    return text if math.isnan(truth) else f"{text}; truth {significant(truth)}{unit}"


def _plus_minus(value: float, deviation: float) -> str:
    """Both to the second digit of the deviation."""
    if not (np.isfinite([value, deviation]).all() and deviation > 0):
        return f"{significant(value)} ± {significant(deviation)}"
    top, last = (math.floor(math.log10(size)) for size in (max(abs(value), deviation), deviation))
    if -3 <= top < 5:
        decimals = max(0, 1 - last)
        return f"{value:.{decimals}f} ± {deviation:.{decimals}f}"
    return f"{value:.{top - last + 1}e} ± {deviation:.1e}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text == MISSING
    return True
