"""The study's tables are read as they are, or refused with the line; ours stand beside them."""

import math

import pytest
from made_up_study import made_up_results

from r2s.study.configuration import MOTIONS, Configuration
from r2s.study.statistics.paper import average, beside_paper, read_paper

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
    assert set(zip(paper.evaluated_on, paper.metric, strict=True)) == {
        (motion, metric) for motion in MOTIONS for metric in ("paper_chamfer", "paper_hausdorff")
    }
    part = paper[(paper.evaluated_on == "fling") & (paper.metric == "paper_chamfer")]
    values = part.set_index(["configuration", "fabric"]).value.to_dict()
    assert values == {
        (DIFFCLOUD.label, "black_denim"): 0.25,
        (DIFFCLOUD.label, "red_jet_set"): 0.75,
        (PINN.label, "black_denim"): 0.5,
        (PINN.label, "red_jet_set"): 1.5,
    }
    assert average(paper, "fling", [DIFFCLOUD, PINN]) == 0.75
    assert math.isnan(average(paper, "fling", [Configuration("", "cloth", "")]))
    assert read_paper(None).empty


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "No columns"),
        ("metric,fabric,diffcloud-bullet-lifting\n", ".*diffcloud-bullet-lifting"),
        (HEADER + "CD,Black Denim,0.25\n", "CD of Black Denim: .*found nan"),
        (HEADER + "MD,Black Denim,0.25,1\n", "found 'MD'"),
        (HEADER + "CD,Black Denim,0.25,many\n", ".*above zero, found 'many'"),
        (HEADER + "CD,Black Denim,-1,1\n", ".*above zero, found '-1'"),
        (HEADER + "CD,Red,1,1\nCD,Red,1,1\n", "CD of Red is given twice"),
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

    results = made_up_results(nan, configurations=[DIFFCLOUD], noise=0.0, trials=2)
    table = beside_paper(results, read_paper(folder), "fling").set_index("fabric")
    assert set(table.columns) == {
        "DIFFCLOUD cloth lifting",
        "default cloth",
        "DIFFCLOUD cloth lifting, paper",
        "PINN points stretching, paper",
    }
    ours, theirs = table["DIFFCLOUD cloth lifting"], table["DIFFCLOUD cloth lifting, paper"]
    assert ours["black_denim"] == pytest.approx(0.4) and theirs["black_denim"] == 0.25
    assert ours["pink_solid"] == ours["mean"] == math.inf and math.isnan(theirs["pink_solid"])
    assert theirs["mean"] == 0.5
    alone = beside_paper(results, read_paper(None), "fling")
    assert list(alone.columns) == ["fabric", "DIFFCLOUD cloth lifting", "default cloth"]
    assert list(beside_paper(results[:0], read_paper(None), "fling").columns) == ["fabric"]
