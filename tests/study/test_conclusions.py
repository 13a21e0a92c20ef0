"""Conclusions of made-up results, in which they are true, false or unclear."""

import math

import numpy as np
import pandas as pd
import pytest
from made_up_study import FABRICS, made_up_results

from r2s.metrics.statistics import interval, p_value
from r2s.study.conclusions import answers, beside_paper, compare, findings, judge, read_paper
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS

DIFFCLOUD_L, DIFFCLOUD_W = PAPER_CONFIGURATIONS[:2]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]
LIFTING, WIND = [DIFFCLOUD_L.label], [DIFFCLOUD_W.label]
MANY = tuple(f"fabric{i}" for i in range(10))  # that is what it takes to tell so many conclusions


def concluded(is_right):
    """Distances that make all conclusions right, or wrong."""
    numbers = (0.01, 0.03, 0.025) if is_right else (0.03, 0.02, 0.02)
    of_motion = dict(zip(MOTIONS, numbers, strict=True))
    worse = {"shaking": "mpm", "fling": "cloth"}
    if not is_right:
        worse = {"shaking": "cloth", "fling": "mpm"}

    def distance(configuration, fabric, motion, trial, repeat):
        value = of_motion[motion]
        if configuration.solver == worse.get(motion):
            value *= 1.5
        if configuration.estimated_from == "wind":
            value *= 0.8 if (motion == "folding") == is_right else 1.3
        if (configuration, motion) in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
            value *= 0.6 if is_right else 2
        return value

    return distance


def made_up(distance=lambda *_: 0.02, **more):
    return made_up_results(distance, metrics=["chamfer"], **more)


def judged(results):
    """A lift against a wind."""
    return judge([("", compare("", results, LIFTING, WIND))]).iloc[0]


@pytest.mark.parametrize(("is_right", "answer"), [(True, "holds"), (False, "does not hold")])
def test_conclusions_that_are_right_hold_and_others_do_not(is_right, answer):
    results = made_up(concluded(is_right), fabrics=MANY)
    found = findings(results)
    assert set(answers(found).values()) == {answer}
    worse = made_up(lambda *_: 0.5, configurations=PUBLISHED_CONFIGURATIONS, fabrics=MANY)
    both = pd.concat([results, worse[worse.baseline == ""]])  # published recipes do not count
    pd.testing.assert_frame_equal(findings(both), found)


def test_what_is_alike_does_not_hold_and_what_is_unclear_is_not_told():
    results = made_up(noise=0.02, trials=20)
    assert judged(results[results.evaluated_on == "fling"]).answer == "does not hold"
    assert judged(made_up(noise=0.4, fabrics=FABRICS[:2])).answer == "undecided"


def test_more_recordings_and_estimates_are_no_more_fabrics():
    """A difference between two fabrics that all of their recordings share is not a finding."""

    def distance(configuration, fabric, *_):
        is_first = fabric == FABRICS[0]
        return 0.02 * (1.1 if configuration == DIFFCLOUD_W else 1) ** (3 if is_first else 1)

    results = made_up(distance, fabrics=FABRICS[:2], trials=20, repeats=10, noise=0.001)
    found = judged(results)
    assert found.fabrics == 2 and found.p > 0.25 and found.low < 1 < found.high
    alone = judged(results[results.fabric == FABRICS[0]])
    assert alone.ratio == pytest.approx(1.1**3, rel=1e-3) and math.isnan(alone.p)
    assert alone.answer == "undecided" and math.isnan(alone.needed)


@pytest.mark.slow(group="study")
def test_studies_without_an_effect_find_no_more_than_chance_does():
    """Fabrics that differ at random, and motions whose differences all fabrics share."""
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

    found = judged(made_up(distance, noise=0.01, trials=2))
    assert found.answer == "undecided" and found.fewest < found.needed < found.most


@pytest.mark.parametrize(
    ("loser", "trials", "answer", "diverged"),
    [
        (None, 0, "holds", (0, 0)),
        (DIFFCLOUD_W, 1, "holds", (0, 20)),  # the worse diverges besides
        (DIFFCLOUD_L, 1, "undecided", (20, 0)),
        (DIFFCLOUD_W, 4, "undecided", (0, 80)),  # all of it
    ],
)
def test_nothing_is_found_in_favour_of_a_side_that_diverged(loser, trials, answer, diverged):
    def some(configuration, fabric, motion, trial, repeat):
        lost = configuration == loser and trial <= trials
        return math.nan if lost else 0.01 if configuration == DIFFCLOUD_L else 0.02

    found = judged(made_up(some, fabrics=MANY, motions=["fling"]))
    assert found.answer == answer
    assert (found.diverged_smaller, found.diverged_larger) == diverged


HEADER = "metric,fabric,diffcloud-diffsim-lifting,pinn-difftaichi-stretching\n"
LINES = "CD,Black Denim,0.25,0.5\nCD,Red Jet Set,0.75,1.5\nCD,Average,9,9\nHD,Black Denim,1.25,2\n"


@pytest.fixture
def folder(tmp_path):
    for motion in MOTIONS:
        (tmp_path / f"{motion}.csv").write_text(HEADER + LINES)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fabric,CD\n", "expected metric,fabric"),
        ("metric,fabric,diffcloud-bullet-lifting\n", "found diffcloud-bullet-lifting"),
        (HEADER + "CD,Black Denim,0.25,many\n", "Black Denim: .*found 'many'"),
        (HEADER + "CD,Black Denim,-1,1\n", "above zero, found '-1'"),
    ],
)
def test_damaged_tables_are_refused(folder, text, message):
    (folder / "fling.csv").write_text(text)
    with pytest.raises(ValueError, match=f"fling.csv: .*{message}"):
        read_paper(folder)


def test_ours_stand_beside_theirs(folder):
    def nan(configuration, fabric, *_):
        return math.nan if fabric == "pink_solid" else 0.02

    results = made_up_results(nan, configurations=[DIFFCLOUD_L], noise=0.0, trials=2)
    table = beside_paper(results, read_paper(folder), "fling").set_index("fabric")
    assert table["PINN mpm stretching, paper"]["red_jet_set"] == 1.5
    ours, theirs = table["DIFFCLOUD cloth lifting"], table["DIFFCLOUD cloth lifting, paper"]
    assert ours["black_denim"] == pytest.approx(0.4) and theirs["black_denim"] == 0.25
    assert ours["pink_solid"] == ours["mean"] == math.inf and math.isnan(theirs["pink_solid"])
    assert theirs["mean"] == 0.5
    assert list(beside_paper(results[:0], read_paper(None), "fling").columns) == ["fabric"]
