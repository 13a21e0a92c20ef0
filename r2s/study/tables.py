"""Tables that people read, and their texts: Markdown, CSV, LaTeX and HTML."""

from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from pathlib import Path

from r2s.files import write_text
from r2s.study import rows

MISSING = "-"


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

    @property
    def body(self) -> tuple[tuple[str, ...], ...]:
        """The lines but for those at the foot."""
        return self.rows[: len(self.rows) - self.foot]

    @property
    def feet(self) -> tuple[tuple[str, ...], ...]:
        """The lines at the foot."""
        return self.rows[len(self.rows) - self.foot :]


def significant(value: float) -> str:
    """A number with three significant digits, without an exponent from 1e-4 up to 1e6."""
    rounded = float(f"{value:.3g}")
    if 1e3 <= abs(rounded) < 1e6:  # "g" would write 1.23e+03
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".removesuffix(".")


def publish(folder: Path | str, name: str, table: Table) -> Table:
    """Write a table as `name`.csv, .md and .tex into a folder, which is made; returns it."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for ending, text in (("csv", csv_text), ("md", markdown), ("tex", latex)):
        write_text(folder / f"{name}.{ending}", text(table))
    return table


def csv_text(table: Table) -> str:
    """The table as CSV, without the caption."""
    return rows.csv_text([table.header, *table.rows])


def markdown(table: Table) -> str:
    """The table in Markdown, the caption above."""
    every = [table.header, ("---",) * len(table.header), *table.rows]
    lines = [[" ".join(cell.replace("|", r"\|").split()) for cell in row] for row in every]
    return f"{table.caption}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex(table: Table) -> str:
    r"""The table as a LaTeX `table`, which needs \usepackage{booktabs}; all text is escaped.

    Columns whose cells are numbers, but for the lines at the foot, are set to the right.
    """
    body = table.body or table.rows
    sides = "".join(
        "r" if body and all(_is_number(row[i]) for row in body) else "l"
        for i in range(len(table.header))
    )
    foot = "\\midrule\n" + _latex_lines(table.feet) if table.foot else ""
    return (
        "\\begin{table}\n\\centering\n"
        f"\\caption{{{_latex_text(table.caption)}}}\n\\begin{{tabular}}{{{sides}}}\n\\toprule\n"
        f"{_latex_lines([table.header])}\\midrule\n{_latex_lines(table.body)}{foot}"
        "\\bottomrule\n\\end{tabular}\n\\end{table}\n"
    )


def html(table: Table) -> str:
    """The table as an HTML fragment of class "sortable", which the script of a report sorts."""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.header)
    return (
        f'<table class="sortable">\n<caption>{escape(table.caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{_html_lines(table.body)}</tbody>\n"
        f"<tfoot>\n{_html_lines(table.feet)}</tfoot>\n</table>\n"
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


def _latex_lines(lines: Iterable[tuple[str, ...]]) -> str:
    return "".join(" & ".join(map(_latex_text, cells)) + r" \\" + "\n" for cells in lines)


def _html_lines(lines: Iterable[tuple[str, ...]]) -> str:
    def cell(text: str) -> str:
        return f"<td{' class=number' if _is_number(text) else ''}>{escape(text)}</td>"

    return "".join(f"<tr>{''.join(map(cell, cells))}</tr>\n" for cells in lines)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text == MISSING
    return True
