"""Rows and tables: what is written is read back, and the numbers shown are right."""

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
from r2s.study.tables import BASELINES, HEADER, Row, Table

RANGES = (
    Range("C11", "N/m", 3.0, 3000.0),
    Range("coupling", "-", -0.9, 0.9, log=False),
    Range("bending", "N m", 1e-7, 1e-3),
)

names = st.one_of(
    st.text(max_size=8), st.sampled_from(['a,b"c', "two\nlines", "\r", "\r\n", " x ", "'", ""])
)
any_row = st.builds(
    Row,
    *([names] * 7),
    baseline=st.sampled_from(list(BASELINES)),
    metric=names,
    unit=names,
    value=st.floats(allow_nan=False),
)


def row(value, recording="towel_1", baseline="", metric="chamfer", on="fold", unit="m"):
    fabric = recording.split("_")[0]
    return Row(
        "gauss_newton", "xpbd", "lift", fabric, "1", recording, on, baseline, metric, unit, value
    )


@settings(max_examples=60, deadline=None)
@given(rows=st.lists(any_row, max_size=4))
def test_rows_are_read_back_as_written(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "results.csv"
    tables.write_rows(path, rows)
    assert tables.read_rows(path) == rows


def test_file_of_rows(tmp_path):
    path = tmp_path / "results.csv"
    tables.write_rows(path, [row(np.float64(0.1)), row(math.nan)])
    lines = path.read_text().splitlines()
    assert lines[0] == (
        "approach,solver,estimated_from,fabric,repeat,recording,evaluated_on,baseline,metric,unit,value"
    )
    assert lines[1] == "gauss_newton,xpbd,lift,towel,1,towel_1,fold,,chamfer,m,0.1"
    assert math.isnan(tables.read_rows(path)[1].value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the header"),
        ("approach,value\n", "expected the header"),
        (",".join(HEADER) + "\na,b\n", "line 2: expected 11 cells, found 2"),
        (",".join(HEADER) + "\na,b,c,d,e,f,g,,h,m,many\n", "line 2: .*many"),
        (",".join(HEADER) + "\na,b,c,d,e,f,g,best,h,m,1.0\n", "line 2: unknown baseline 'best'"),
    ],
)
def test_damaged_rows_are_refused(tmp_path, text, message):
    path = tmp_path / "damaged.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        tables.read_rows(path)
    assert str(path) in str(caught.value)
    with pytest.raises(FileNotFoundError, match="nowhere.csv"):
        tables.read_rows(tmp_path / "nowhere.csv")


def test_pivot_shows_millimetres_and_means_of_what_is_there():
    rows = [
        row(0.010, "towel_1"),
        row(0.0301, "towel_1", "default"),
        row(0.020, "rag_1"),
        row(0.005, "rag_1", "repeatability"),
        row(0.9, "towel_1", on="lift"),
        row(0.9, "towel_1", metric="area", unit="m^2"),
    ]
    table = tables.pivot(rows, "chamfer", "fold")
    assert table.header == (
        "fabric",
        "recording",
        "estimate [mm]",
        "default [mm]",
        "other fabric [mm]",
        "repeatability [mm]",
    )
    assert table.rows == (
        ("towel", "towel_1", "10.0", "30.1", "-", "-"),
        ("rag", "rag_1", "20.0", "-", "-", "5.0"),
        ("mean", "", "15.0", "30.1", "-", "5.0"),
    )
    assert (table.foot, table.caption) == (1, "chamfer [mm] on fold")


def test_pivot_of_another_unit():
    rows = [row(0.123456, unit="-"), row(2.0, "rag_1", unit="-")]
    table = tables.pivot(rows, "chamfer", "fold")
    assert table.header[2] == "estimate"
    assert [line[2] for line in table.rows] == ["0.123", "2.00", "1.06"]


def test_pivot_refuses_what_has_no_one_answer():
    with pytest.raises(ValueError, match="no rows of 'chamfers'.*chamfer"):
        tables.pivot([row(1.0)], "chamfers", "fold")
    with pytest.raises(ValueError, match="several values.*towel_1"):
        tables.pivot([row(1.0), row(2.0)], "chamfer", "fold")
    with pytest.raises(ValueError, match="several units"):
        tables.pivot([row(1.0), row(2.0, "rag_1", unit="mm")], "chamfer", "fold")
    with pytest.raises(ValueError, match="unknown baseline"):
        row(1.0, baseline="other fabric")


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
    determined = np.array([True, True, False])
    known = np.array([100.0, np.nan, 2e-5])
    values, deviations = np.array([123.4, -0.25, 1e-5]), np.array([0.1, 0.1, 3.0])
    damping = (Range("damping", "s", 1e-3, 1e-1),)
    bending = (RANGES[2],)
    one = np.ones(1)
    table = tables.parameter_table(
        [
            ("towel_1", RANGES, values, deviations, determined, known),
            ("rag_1", damping, one * 0.01, one * 0.5, np.array([True]), None),
            ("rag_2", bending, one * 1.234e-5, one * 0.1, np.array([True]), None),
        ]
    )
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
    with pytest.raises(ValueError, match="towel_9: expected 3"):
        tables.parameter_table([("towel_9", RANGES, values[:2], deviations, determined, None)])


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
