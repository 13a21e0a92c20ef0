"""Conclusions and ranks of made-up results, in which they are true, false or unclear."""

import math

import numpy as np
import pandas as pd
import pytest
from made_up_study import FABRICS, made_up_results

from r2s.metrics.statistics import interval, p_value
from r2s.study.comparisons import answers, compare, critical_difference, judge, rank
from r2s.study.conclusions import average, beside_paper, findings, read_paper
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS

DIFFCLOUD_L, DIFFCLOUD_W, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]
LIFTING, WIND = [DIFFCLOUD_L.label], [DIFFCLOUD_W.label]
NO_PAPER = read_paper(None)
MANY = tuple(f"fabric{i}" for i in range(10))  # that is what it takes to tell so many conclusions


def concluded(is_right):
    """Distances that make all conclusions right, or wrong."""
    of_motion = (0.01, 0.03, 0.025) if is_right else (0.03, 0.02, 0.02)
    worse = (
        {"shaking": "mpm", "fling": "cloth"} if is_right else {"shaking": "cloth", "fling": "mpm"}
    )
    best = 0.6 if is_right else 2

    def distance(configuration, fabric, motion, trial, repeat):
        value = of_motion[("folding", "fling", "shaking").index(motion)]
        if configuration.solver == worse.get(motion):
            value *= 1.5
        if configuration.estimated_from == "wind":
            value *= 0.8 if (motion == "folding") == is_right else 1.3
        if (configuration, motion) in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
            value *= best
        if (configuration.approach == "physnet") == is_right:  # repeats differ
            value *= math.exp(0.4 * (-1) ** (repeat + is_right * ord(fabric[-1])))
        explodes = is_right and configuration == DIFFCP and motion == "shaking" and repeat < 3
        return math.nan if explodes else value

    return distance


def made_up(distance, **more):
    return made_up_results(distance, metrics=["chamfer"], **more)


@pytest.fixture(scope="module")
def right():
    return made_up(concluded(True), fabrics=MANY, trials=6, repeats=4)


@pytest.mark.slow(group="study")
def test_conclusions_that_are_right_hold(right):
    *found, physnet = answers(findings(right, NO_PAPER)).values()
    assert set(found) == {"holds"}
    assert physnet == "undecided"  # DiffCP diverges: how much its repeats differ is not known
    without = findings(right[right.approach != "diffcp"], NO_PAPER)
    assert list(answers(without).values())[-1] == "holds"


def test_conclusions_that_are_wrong_do_not():
    wrong = made_up(concluded(False), fabrics=MANY, trials=6, repeats=4)
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
        found = compare("", results, LIFTING, WIND).effect
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


@pytest.fixture
def folder(tmp_path):
    for motion in MOTIONS:
        (tmp_path / f"{motion}.csv").write_text(HEADER + LINES)
    return tmp_path


def test_tables_are_read(folder):
    paper = read_paper(folder)
    assert set(paper.metric) == {"paper_chamfer", "paper_hausdorff"}
    assert paper.groupby("evaluated_on").size().to_dict() == dict.fromkeys(MOTIONS, 6)
    part = paper[(paper.evaluated_on == "fling") & (paper.metric == "paper_chamfer")]
    values = part.set_index(["configuration", "fabric"]).value
    assert values[DIFFCLOUD_L.label].to_dict() == {"black_denim": 0.25, "red_jet_set": 0.75}
    assert values[PINN_POINTS.label].to_dict() == {"black_denim": 0.5, "red_jet_set": 1.5}
    assert average(paper, "fling", [DIFFCLOUD_L, PINN_POINTS]) == 0.75
    assert math.isnan(average(paper, "fling", [DIFFCLOUD_W]))
    assert read_paper(None).empty


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "No columns"),
        ("metric,fabric,diffcloud-bullet-lifting\n", ".*diffcloud-bullet-lifting"),
        (HEADER + "MD,Black Denim,0.25,1\n", "found 'MD'"),
        (HEADER + "CD,Black Denim,0.25,many\n", "CD of Black Denim: .*found 'many'"),
        (HEADER + "CD,Black Denim,-1,1\n", ".*above zero, found '-1'"),
        (HEADER + "CD,Red,1,1\nCD,Red,1,1\n", "CD of Red is given twice"),
    ],
)
def test_damaged_tables_are_refused(folder, text, message):
    (folder / "fling.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_paper(folder)
    assert "fling.csv" in str(caught.value)


def test_ours_stand_beside_theirs(folder):
    def nan(configuration, fabric, *_):
        return math.nan if fabric == "pink_solid" else 0.02

    results = made_up_results(nan, configurations=[DIFFCLOUD_L], noise=0.0, trials=2)
    table = beside_paper(results, read_paper(folder), "fling").set_index("fabric")
    assert {"default cloth", "PINN mpm stretching, paper"} < set(table.columns)
    ours, theirs = table["DIFFCLOUD cloth lifting"], table["DIFFCLOUD cloth lifting, paper"]
    assert ours["black_denim"] == pytest.approx(0.4) and theirs["black_denim"] == 0.25
    assert ours["pink_solid"] == ours["mean"] == math.inf and math.isnan(theirs["pink_solid"])
    assert theirs["mean"] == 0.5
    assert list(beside_paper(results[:0], read_paper(None), "fling").columns) == ["fabric"]


def flings(distance=lambda *_: 0.02, motions=("fling",), **more):
    return made_up_results(distance, metrics=["chamfer"], motions=motions, **more)


def test_ranks_do_not_see_how_hard_a_recording_is():
    def ordered(configuration, fabric, motion, trial, repeat):
        return 0.01 * (1 + PAPER_CONFIGURATIONS.index(configuration)) * trial**3

    found = rank(flings(ordered, noise=0.0))
    assert found is not None and "12 recordings, 3 fabrics" in found.words
    labels = [each.label for each in PAPER_CONFIGURATIONS]
    assert np.all(np.diff(found.table["mean"][labels]) > 0)
    assert np.all(found.table.low <= found.table.high)
    assert found.p < 0.01 and found.table["first"].sum() == pytest.approx(1)
    # the default, 40 mm, is first only where recordings are hard
    assert found.table.index[0] == "DIFFCLOUD cloth lifting"


def test_what_diverged_is_last():
    def some(configuration, f, m, trial, repeat):
        return math.nan if configuration.approach == "diffcp" and repeat == 2 else 0.02

    found = rank(flings(some))
    assert found is not None
    assert found.table["mean"]["DiffCP mpm lifting"] == len(found.table)


def test_what_is_judged_on_less_than_half_is_left_out():
    results = flings()
    results = results[(results.approach != "diffcp") | (results.fabric == "pink_solid")]
    is_lost = (results.approach == "pinn") & results.recording.str.endswith("denim1")
    found = rank(results[~is_lost])
    assert found is not None
    assert "11 recordings" in found.words and "left out DiffCP mpm lifting" in found.words


def test_critical_difference_is_that_of_the_tables():
    # Demsar 2006, table 5: q = 2.343 for 3 configurations, 3.164 for 10.
    assert critical_difference(3, 30) == pytest.approx(2.343 * math.sqrt(12 / 180), rel=1e-3)
    assert critical_difference(10, 14) == pytest.approx(3.164 * math.sqrt(110 / 84), rel=1e-3)
