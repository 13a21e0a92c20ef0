"""Tables: the numbers shown are right, and every text says the same."""

import csv
import io
import math
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.fabrics.parameters import Range
from r2s.study import tables
from r2s.study.statistics.parameters import Estimated, parameter_table
from r2s.study.tables import Table

RANGES = (
    Range("C11", "N/m", 3.0, 3000.0),
    Range("coupling", "-", -0.9, 0.9, log=False),
    Range("bending", "N m", 1e-7, 1e-3),
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.00"),
        (1.5, "1.50"),
        (150.2, "150"),
        (999.9, "1000"),
        (-12345.0, "-12300"),
        (1e-7, "1.00e-07"),
        (math.inf, "inf"),
    ],
)
def test_significant(value, text):
    assert tables.significant(value) == text


def test_parameters_with_deviations_bounds_and_truth():
    determined, known = np.array([True, True, False]), np.array([100.0, np.nan, 2e-5])
    values, deviations = np.array([123.4, -0.25, 1e-5]), np.array([0.1, 0.1, 3.0])
    damping = (Range("damping", "s", 1e-3, 1e-1),)
    one, sure, unknown = np.ones(1), np.array([True]), np.array([np.nan])
    estimates = [
        Estimated("towel_1", RANGES, values, deviations, determined, known),
        Estimated("rag_1", damping, one * 0.01, one * 0.5, sure, unknown),
        Estimated("rag_2", RANGES[2:], one * 1.234e-5, one * 0.1, sure, unknown),
    ]
    table = parameter_table(estimates, "Parameters")
    assert table.header == ("recording", "C11", "coupling", "bending", "damping")
    assert table.rows[0] == (
        "towel_1",
        "123 ± 12 N/m; truth 100 N/m",  # relative, for the range is logarithmic
        "-0.25 ± 0.10",  # absolute
        "not determined (best fit 1.00e-05 N m); truth 2.00e-05 N m",
        "-",
    )
    assert table.rows[1] == ("rag_1", "-", "-", "-", "0.0100 ± 0.0050 s")
    assert table.rows[2][3] == "1.23e-05 ± 1.2e-06 N m"
    with pytest.raises(ValueError):
        parameter_table([Estimated("", RANGES, values[:2], deviations, determined, known)], "")


def test_table_checks_its_shape():
    with pytest.raises(ValueError, match="line 0 has 1 cells, the header 2"):
        Table(("a", "b"), (("1",),), "")
    with pytest.raises(ValueError, match="foot is 2"):
        Table(("a",), (("1",),), "", foot=2)


AWKWARD = Table(("name", "x<y"), (("a|b", "1,5"), ("two\nlines", "2"), ("all", "3")), "<c>", foot=1)


def test_markdown_keeps_its_cells():
    lines = tables.markdown(AWKWARD).splitlines()
    assert lines == [
        "<c>",
        "",
        "| name | x<y |",
        "| --- | --- |",
        r"| a\|b | 1,5 |",
        "| two lines | 2 |",
        "| all | 3 |",
    ]


def test_csv_text_is_read_back():
    read = list(csv.reader(io.StringIO(tables.csv_text(AWKWARD), newline="")))
    assert [tuple(line) for line in read] == [AWKWARD.header, *AWKWARD.rows]


class Cells(HTMLParser):
    """Collects the text of the cells, by the part of the table that they are in."""

    def __init__(self):
        super().__init__()
        self.parts, self.part, self.classes = {}, "", []

    def handle_starttag(self, tag, attrs):
        self.part = tag if tag in ("caption", "thead", "tbody", "tfoot") else self.part
        if tag == "table":
            self.classes += [dict(attrs)["class"]]

    def handle_data(self, data):
        if data.strip():
            self.parts.setdefault(self.part, []).append(data)


def test_html_escapes_and_parts():
    parser = Cells()
    text = tables.html(AWKWARD)
    parser.feed(text)
    assert parser.classes == ["sortable"]
    assert parser.parts == {
        "caption": ["<c>"],
        "thead": ["name", "x<y"],
        "tbody": ["a|b", "1,5", "two\nlines", "2"],
        "tfoot": ["all", "3"],
    }
    assert "<c>" not in text and "x<y" not in text


def test_latex_escapes_and_sets_numbers_to_the_right():
    table = Table(("name_1", "[mm]"), (("a & b", "1.5"), ("50 %\n", "-"), ("all", "x")), "C^2 ±", 1)
    assert tables.latex(table).splitlines() == [
        r"\begin{table}",
        r"\centering",
        r"\caption{C\textasciicircum{}2 $\pm$}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"name\_1 & {[}mm] \\",
        r"\midrule",
        r"a \& b & 1.5 \\",
        r"50 \% & - \\",
        r"\midrule",
        r"all & x \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]


LATEX_COMMANDS = (
    r"\textbackslash{}", r"\textasciitilde{}", r"\textasciicircum{}", r"\textless{}",
    r"\textgreater{}", r"\textbar{}", r"$\pm$", r"$\times$", r"$^2$", "{[}",
    *("\\" + c for c in "&%$#_{}"),
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(text=st.text(max_size=8) | st.text('\\{}&%$#_~^<>|[]"±² \n', max_size=8))
def test_latex_has_no_character_that_means_something(text):
    line = tables.latex(Table((text,), (), "")).splitlines()[5]
    assert line.endswith(r" \\") and len(line.splitlines()) == 1
    line = line.removesuffix(r" \\")
    for command in LATEX_COMMANDS:
        line = line.replace(command, "")
    assert not set(line) & set("\\{}&%$#_~^")


def test_a_table_is_published_three_ways(tmp_path):
    assert tables.publish(tmp_path / "new", "name", AWKWARD) is AWKWARD
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "name.csv", "name.md", "name.tex"
    ]  # fmt: skip
    assert (tmp_path / "new" / "name.md").read_text() == tables.markdown(AWKWARD)
