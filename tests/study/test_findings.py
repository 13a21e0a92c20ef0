"""Conclusions are told right where made-up results make them true, false or unclear."""

import math

import numpy as np
import pandas as pd
import pytest
from made_up_study import FABRICS, made_up_results

from r2s.metrics.statistics import interval, p_value
from r2s.study.configuration import (
    MOTIONS,
    PAPER_CONFIGURATIONS,
    PUBLISHED_CONFIGURATIONS,
    Configuration,
)
from r2s.study.statistics.comparisons import answers, compare, judge
from r2s.study.statistics.conclusions import average, beside_paper, findings, read_paper

DIFFCLOUD_L, DIFFCLOUD_W, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]
LIFTING, WIND = [DIFFCLOUD_L.label], [DIFFCLOUD_W.label]
NO_PAPER = read_paper(None)
MANY = tuple(f"fabric{i}" for i in range(10))  # that is what it takes to tell so many conclusions


def as_concluded(configuration, fabric, motion, trial, repeat):
    """Distances that make all conclusions right."""
    value = {"folding": 0.01, "fling": 0.03, "shaking": 0.025}[motion]
    if motion == "shaking" and configuration.solver == "mpm":
        value *= 1.5
    if motion == "fling" and configuration.solver == "cloth":
        value *= 1.5
    if configuration.estimated_from == "wind":
        value *= 0.8 if motion == "folding" else 1.3
    if (configuration, motion) in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
        value *= 0.6
    if configuration.approach == "physnet":  # repeats are not alike in all fabrics
        value *= math.exp(0.4 * (-1) ** (repeat + ord(fabric[-1])))
    return math.nan if configuration == DIFFCP and motion == "shaking" and repeat < 3 else value


def reversed_of(configuration, fabric, motion, trial, repeat):
    """Distances that make them wrong."""
    value = {"folding": 0.03, "fling": 0.02, "shaking": 0.02}[motion]
    if motion == "shaking" and configuration.solver == "cloth":
        value *= 1.5
    if motion == "fling" and configuration.solver == "mpm":
        value *= 1.5
    if configuration.estimated_from == "wind":
        value *= 1.3 if motion == "folding" else 0.8
    if (configuration, motion) in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
        value *= 2
    return value * math.exp(0.4 * (-1) ** repeat) if configuration.approach != "physnet" else value


def made_up(distance, **more):
    return made_up_results(distance, metrics=["chamfer"], **more)


@pytest.fixture(scope="module")
def right():
    return made_up(as_concluded, fabrics=MANY, trials=6, repeats=4)


@pytest.mark.slow(group="study")
def test_conclusions_that_are_right_hold(right):
    *found, physnet = answers(findings(right, NO_PAPER)).values()
    assert set(found) == {"holds"}
    assert physnet == "undecided"  # DiffCP diverges: how much its repeats differ is not known
    without = findings(right[right.approach != "diffcp"], NO_PAPER)
    assert list(answers(without).values())[-1] == "holds"


def test_conclusions_that_are_wrong_do_not():
    wrong = made_up(reversed_of, fabrics=MANY, trials=6, repeats=4)
    *found, diffcp, physnet = answers(findings(wrong, NO_PAPER)).values()
    assert diffcp == "undecided"  # none diverged
    assert {*found, physnet} == {"does not hold"}


@pytest.mark.slow(group="study")
def test_findings_are_not_of_published_recipes(right):
    worse = made_up(
        lambda *_: 0.5, configurations=PUBLISHED_CONFIGURATIONS, fabrics=MANY, trials=6, repeats=4
    )
    both = pd.concat([right, worse[worse.baseline == ""]])
    pd.testing.assert_frame_equal(findings(both, NO_PAPER), findings(right, NO_PAPER))


def test_what_is_alike_does_not_hold_and_what_is_unclear_is_not_told():
    results = made_up(lambda *_: 0.02, noise=0.02, trials=20)
    alike = compare("", results[results.evaluated_on == "fling"], LIFTING, WIND)
    few = made_up(lambda *_: 0.02, noise=0.4, fabrics=FABRICS[:2])
    judged = judge([("alike", alike), ("unclear", compare("", few, LIFTING, WIND))])
    assert list(judged.answer) == ["does not hold", "undecided"]


def test_more_recordings_and_estimates_are_no_more_fabrics():
    """A difference between two fabrics that all of their recordings share is not a finding."""

    def distance(configuration, fabric, *_):
        is_first = fabric == FABRICS[0]
        return 0.02 * (1.1 if configuration == DIFFCLOUD_W else 1) ** (3 if is_first else 1)

    results = made_up(distance, fabrics=FABRICS[:2], trials=20, repeats=10, noise=0.001)
    found = judge([("", compare("", results, LIFTING, WIND))]).iloc[0]
    assert found.agreeing == found.fabrics == 2
    assert found.p > 0.25 and found.low < 1 < found.high
    one = results[results.fabric == FABRICS[0]]
    alone = judge([("", compare("", one, LIFTING, WIND))])
    assert alone.ratio[0] == pytest.approx(1.1**3, rel=1e-3) and math.isnan(alone.p[0])
    assert alone.answer[0] == "undecided" and math.isnan(alone.needed[0])


@pytest.mark.slow(group="study")
def test_studies_without_an_effect_find_no_more_than_chance_does():
    """Two fabrics that differ at random, and motions whose differences all fabrics share."""
    generator, p, held = np.random.default_rng(0), [], 0
    for _ in range(150):
        fabric, motion = 0.3 * generator.normal(size=3), 0.1 * generator.normal(size=4)

        def distance(configuration, name, _, trial, repeat, f=fabric, m=motion):
            is_wind = configuration == DIFFCLOUD_W
            return 0.02 * math.exp(is_wind * (f[FABRICS.index(name)] + m[trial - 1]))

        seed = int(generator.integers(1 << 30))
        results = made_up(distance, configurations=[DIFFCLOUD_L, DIFFCLOUD_W], seed=seed,
                          motions=["fling"], repeats=1)  # fmt: skip
        found = compare("", results, LIFTING, WIND).found
        low, high = interval(found)
        p.append(p_value(found))
        held += low < 0 < high
    assert np.mean(np.array(p) < 0.05) <= 0.07 and 0.84 < held / 150 < 0.97


def test_what_cannot_be_told_says_how_many_fabrics_would_tell():
    ratio = dict(zip(FABRICS, (1.02, 1.4, 1.2), strict=True))

    def distance(configuration, fabric, *_):
        return 0.02 * (ratio[fabric] if configuration == DIFFCLOUD_W else 1)

    judged = judge([("", compare("", made_up(distance, noise=0.01, trials=2), LIFTING, WIND))])
    found = judged.iloc[0]
    assert found.answer == "undecided" and found.fewest < found.needed < found.most


def test_nothing_is_found_in_favour_of_a_side_that_diverged():
    def compared(loser, share):
        def some(configuration, fabric, motion, trial, repeat):
            lost = configuration == loser and trial <= share
            return math.nan if lost else 0.01 if configuration == DIFFCLOUD_L else 0.02

        results = made_up(some, fabrics=MANY, motions=["fling"])
        return judge([("", compare("", results, LIFTING, WIND))]).iloc[0]

    assert compared(None, 0).answer == "holds"
    loses = compared(DIFFCLOUD_W, 1)  # the worse diverges besides
    assert loses.answer == "holds"
    assert (loses.diverged_smaller, loses.diverged_larger) == (0, 20)
    wins = compared(DIFFCLOUD_L, 1)
    assert wins.answer == "undecided" and wins.diverged_smaller == 20
    nothing = compared(DIFFCLOUD_W, 4)
    assert nothing.lacking == "all of it diverged" and nothing.answer == "undecided"


def test_estimates_that_diverge_by_chance_are_no_explosion():
    """One estimate a fabric, of which DiffCP's diverged in both: two fabrics do not tell."""

    def some(configuration, *_):
        return math.nan if configuration == DIFFCP else 0.02

    judged = findings(made_up(some, fabrics=FABRICS[:2], repeats=1), NO_PAPER)
    found = judged[judged.conclusion.str.contains("explode")].iloc[0]
    assert found.answer == "undecided" and found.p > 0.05
    assert found.comparison.endswith("2 of 2, 0 of 14")


HEADER = "metric,fabric,diffcloud-diffsim-lifting,pinn-difftaichi-stretching\n"
LINES = "CD,Black Denim,0.25,0.5\nCD,Red Jet Set,0.75,1.5\nCD,Average,9,9\nHD,Black Denim,1.25,2\n"
DIFFCLOUD, PINN = (
    Configuration("diffcloud", "cloth", "lifting"),
    Configuration("pinn", "mpm", "stretching"),
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
        "PINN mpm stretching, paper",
    }
    ours, theirs = table["DIFFCLOUD cloth lifting"], table["DIFFCLOUD cloth lifting, paper"]
    assert ours["black_denim"] == pytest.approx(0.4) and theirs["black_denim"] == 0.25
    assert ours["pink_solid"] == ours["mean"] == math.inf and math.isnan(theirs["pink_solid"])
    assert theirs["mean"] == 0.5
    alone = beside_paper(results, read_paper(None), "fling")
    assert list(alone.columns) == ["fabric", "DIFFCLOUD cloth lifting", "default cloth"]
    assert list(beside_paper(results[:0], read_paper(None), "fling").columns) == ["fabric"]
