"""The study's tables are read as they are, or refused with the line; ours stand beside them."""

import math

import pytest
from made_up_study import made_up_rows

from r2s.study.configuration import MOTIONS, Configuration
from r2s.study.statistics.paper import average, beside_paper, paper_tables, read_paper

HEADER = "metric,fabric,diffcloud-diffsim-lifting,pinn-difftaichi-stretching\n"
LINES = "CD,Black Denim,0.25,0.5\nCD,Red Jet Set,0.75,1.5\nCD,Average,9,9\nHD,Black Denim,1.25,2\n"
DIFFCLOUD, PINN = (
    Configuration("diffcloud", "cloth", "lifting"),
    Configuration("pinn", "points", "stretching"),
)


@pytest.fixture
def folder(tmp_path):
    for motion in MOTIONS:
        (tmp_path / f"{motion}.csv").write_text(HEADER + LINES)
    return tmp_path


def test_tables_are_read(folder):
    paper = read_paper(folder)
    assert set(paper) == {(m, d) for m in MOTIONS for d in ("paper_chamfer", "paper_hausdorff")}
    assert paper["fling", "paper_chamfer"] == {
        DIFFCLOUD: {"black_denim": 0.25, "red_jet_set": 0.75},
        PINN: {"black_denim": 0.5, "red_jet_set": 1.5},
    }
    assert average(paper, "fling", "paper_chamfer", [DIFFCLOUD, PINN]) == 0.75
    assert math.isnan(average(paper, "fling", "paper_chamfer", [Configuration("", "cloth", "")]))
    assert read_paper(None) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: expected metric,fabric"),
        ("metric,fabric,diffcloud-bullet-lifting\n", "line 1: .*diffcloud-bullet-lifting"),
        (HEADER + "CD,Black Denim,0.25\n", "line 2: expected 4 cells, found 3"),
        (HEADER + "MD,Black Denim,0.25,1\n", "line 2: .*found 'MD'"),
        (HEADER + "CD,Black Denim,0.25,many\n", "line 2: .*above zero, found 'many'"),
        (HEADER + "CD,Black Denim,-1,1\n", "line 2: .*above zero, found '-1'"),
        (HEADER + "CD,Red,1,1\nCD,Red,1,1\n", "line 3: CD of Red is given twice"),
    ],
)
def test_damaged_tables_are_refused(folder, text, message):
    (folder / "fling.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_paper(folder)
    assert "fling.csv" in str(caught.value)
    (folder / "fling.csv").unlink()
    with pytest.raises(FileNotFoundError, match="fling.csv"):
        read_paper(folder)


def test_ours_stand_beside_theirs(folder):
    def nan(configuration, fabric, *_):
        return math.nan if fabric == "pink_solid" else 0.02

    rows = made_up_rows(nan, configurations=[DIFFCLOUD], noise=0.0, trials=2)
    table = beside_paper(rows, read_paper(folder), "fling", "paper_chamfer")
    assert table.header == (
        "fabric",
        "DIFFCLOUD cloth lifting",
        "DIFFCLOUD cloth lifting, paper",
        "PINN points stretching",
        "PINN points stretching, paper",
        "default cloth",
    )
    assert table.rows[0] == ("black denim", "0.400", "0.250", "-", "0.500", "0.800")
    assert table.rows[2] == ("pink solid", "diverged", "-", "-", "-", "0.800")
    assert table.rows[3] == ("red jet set", "-", "0.750", "-", "1.500", "-")
    assert table.rows[4][:3] == ("mean", "median 0.400 (4 of 12 diverged)", "0.500")
    assert "Ru et al. 2025" in table.caption and table.foot == 1


def test_without_the_paper_there_are_ours_alone(folder):
    rows = made_up_rows(configurations=[DIFFCLOUD], motions=["fling"])
    tables = paper_tables(rows, {})
    assert list(tables) == ["fling_paper_chamfer"]
    assert tables["fling_paper_chamfer"].header == (
        "fabric", "DIFFCLOUD cloth lifting", "default cloth"
    )  # fmt: skip
    assert "Ru" not in tables["fling_paper_chamfer"].caption
    assert paper_tables([], {}) == {}
    theirs = paper_tables([], read_paper(folder))["shaking_paper_hausdorff"]
    assert theirs.rows == (("black denim", "1.250", "2.000"), ("mean", "1.250", "2.000"))
