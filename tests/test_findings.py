"""Conclusions are told right where made-up rows make them true, false or unclear."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_study import FABRICS, made_up_rows

from r2s.evaluation.statistics import holm
from r2s.study.configuration import PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS
from r2s.study.statistics.conclusions import CONCLUSIONS
from r2s.study.statistics.findings import find, finding_table, in_words
from r2s.study.statistics.hypotheses import Claim, compare, judge
from r2s.study.statistics.result_array import result_array

DIFFCLOUD_L, DIFFCLOUD_W, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]


def as_concluded(configuration, fabric, motion, trial, repeat):
    """Distances that make all conclusions right."""
    value = {"folding": 0.01, "fling": 0.03, "shaking": 0.025}[motion]
    if motion == "shaking" and configuration.solver == "points":
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
    if motion == "fling" and configuration.solver == "points":
        value *= 1.5
    if configuration.estimated_from == "wind":
        value *= 1.3 if motion == "folding" else 0.8
    if (configuration, motion) in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
        value *= 2
    return value * math.exp(0.4 * (-1) ** repeat) if configuration.approach != "physnet" else value


MANY = tuple(f"fabric{i}" for i in range(10))  # that is what it takes to tell so many conclusions


@pytest.fixture(scope="module")
def right():
    return find(made_up_rows(as_concluded, fabrics=MANY, trials=6, repeats=4), {})


def test_findings_are_not_of_published_recipes(right):
    worse = made_up_rows(
        lambda *_: 0.5, configurations=PUBLISHED_CONFIGURATIONS, fabrics=MANY, trials=6, repeats=4
    )
    rows = made_up_rows(as_concluded, fabrics=MANY, trials=6, repeats=4)
    found = find([*rows, *(row for row in worse if row.approach)], {})
    assert list(map(in_words, found)) == list(map(in_words, right))


def answers(verdicts):
    return dict(zip((f.__name__ for f in CONCLUSIONS), (v.answer for v in verdicts), strict=True))


def test_conclusions_that_are_right_hold(right):
    found = answers(right)
    # DiffCP diverges: how much its repeats differ is not known.
    assert found.pop("physnet_varies_most") == "cannot be told"
    assert set(found.values()) == {"holds"}
    rows = made_up_rows(as_concluded, fabrics=MANY, trials=6, repeats=4)
    without = [row for row in rows if row.approach != "diffcp"]
    assert answers(find(without, {}))["physnet_varies_most"] == "holds"


def test_conclusions_that_are_wrong_do_not():
    found = answers(find(made_up_rows(reversed_of, fabrics=MANY, trials=6, repeats=4), {}))
    assert found.pop("diffcp_explodes") == "cannot be told"  # none diverged
    assert set(found.values()) == {"does not hold"}


def test_what_is_alike_does_not_hold_and_what_is_unclear_is_not_told():
    results = result_array(made_up_rows(noise=0.02, trials=20), "chamfer", ("fling",))
    alike = compare("", results, [DIFFCLOUD_L], [DIFFCLOUD_W])
    few = result_array(made_up_rows(noise=0.4, fabrics=FABRICS[:2]), "chamfer")
    unclear = compare("", few, [DIFFCLOUD_L], [DIFFCLOUD_W])
    found = [verdict.answer for verdict in judge([Claim("", (alike,)), Claim("", (unclear,))])]
    assert found == ["does not hold", "cannot be told"]


def test_more_recordings_and_estimates_are_no_more_fabrics():
    """A difference between two fabrics that all of their recordings share is not a finding."""

    def distance(configuration, fabric, motion, trial, repeat):
        is_first = fabric == FABRICS[0]
        return 0.02 * (1.1 if configuration == DIFFCLOUD_W else 1) ** (3 if is_first else 1)

    rows = made_up_rows(distance, fabrics=FABRICS[:2], trials=20, repeats=10, noise=0.001)
    found = compare("", result_array(rows, "chamfer"), [DIFFCLOUD_L], [DIFFCLOUD_W])
    assert found.agreeing == found.found.units == 2
    assert found.p > 0.25 and found.ends[0] < 1 < found.ends[1]
    one = result_array([row for row in rows if row.fabric == FABRICS[0]], "chamfer")
    alone = compare("", one, [DIFFCLOUD_L], [DIFFCLOUD_W])
    assert alone.ratio == pytest.approx(1.1**3, rel=1e-3) and math.isnan(alone.p)
    words = in_words(judge([Claim("Lifting is better.", (alone,))])[0])
    assert words.startswith("Cannot be told") and "not known from one fabric" in words


def test_what_cannot_be_told_says_how_many_fabrics_would_tell():
    ratio = dict(zip(FABRICS, (1.02, 1.4, 1.2), strict=True))

    def distance(configuration, fabric, *_):
        return 0.02 * (ratio[fabric] if configuration == DIFFCLOUD_W else 1)

    rows = made_up_rows(distance, noise=0.01, trials=2)
    claim = Claim("", (compare("", result_array(rows, "chamfer"), [DIFFCLOUD_L], [DIFFCLOUD_W]),))
    verdict = judge([claim])[0]
    likely, fewest, most = verdict.needed[0]
    assert verdict.answer == "cannot be told" and fewest < likely < most
    assert f"fabrics that would tell: {likely:.0f} ({fewest:.0f} to" in in_words(verdict)
    column = finding_table([verdict], "chamfer").header.index("fabrics needed")
    assert finding_table([verdict], "chamfer").rows[0][column].startswith(f"{likely:.0f} (")


def test_missing_columns_are_said():
    rows = [row for row in made_up_rows(trials=2) if row.approach != "pinn"]
    for metric_rows in (rows, [], made_up_rows(configurations=[], trials=2)):
        for verdict in find(metric_rows, {}):
            assert verdict.answer in ("cannot be told", "does not hold")
            assert in_words(verdict)
    words = "\n".join(in_words(verdict) for verdict in find(rows, {}))
    assert "no rows of PINN cloth stretching" in words
    assert finding_table(find([], {}), "chamfer").rows[0][1] == "cannot be told"


def test_the_paper_is_quoted_when_it_is_there(right):
    values = {
        configuration: {"black_denim": 0.1 * (i + 1)}
        for i, configuration in enumerate(PAPER_CONFIGURATIONS)
    }
    paper = {(m, "paper_chamfer"): values for m in ("folding", "fling", "shaking")}
    found = find(made_up_rows(as_concluded, trials=2), paper)
    table = finding_table(found, "chamfer")
    lifting = [line for line in table.rows if line[2].startswith("lifting better than wind")]
    assert lifting[0][-1] == "0.100 against 0.200"
    assert "the paper has 2 times in squared units" in in_words(found[3])
    assert "paper has" not in in_words(right[3])
    assert finding_table(right, "chamfer").rows[0][-1] == "-"


def test_nothing_is_found_in_favour_of_a_side_that_diverged():
    def better(configuration, fabric, motion, trial, repeat):
        return 0.01 if configuration == DIFFCLOUD_L else 0.02

    def compared(loser, share):
        def some(configuration, fabric, motion, trial, repeat):
            lost = configuration == loser and trial <= share
            return math.nan if lost else better(configuration, fabric, motion, trial, repeat)

        results = result_array(made_up_rows(some, fabrics=MANY), "chamfer", ("fling",))
        comparison = compare("", results, [DIFFCLOUD_L], [DIFFCLOUD_W])
        return comparison, judge([Claim("", (comparison,))])[0]

    assert compared(None, 0)[1].answer == "holds"
    loses, verdict = compared(DIFFCLOUD_W, 1)  # the worse diverges besides
    assert verdict.answer == "holds" and loses.diverged == (0, 20)
    wins, verdict = compared(DIFFCLOUD_L, 1)
    assert verdict.answer == "cannot be told" and wins.diverged == (20, 0)
    words = in_words(verdict)
    assert "20 and 0 runs of the two sides diverged" in words and "no number, while" in words
    nothing, verdict = compared(DIFFCLOUD_W, 4)
    assert nothing.lacking == "all of it diverged" and verdict.answer == "cannot be told"


def test_estimates_that_diverge_by_chance_are_no_explosion():
    """One estimate a fabric, of which DiffCP's diverged in both: two fabrics do not tell."""

    def some(configuration, fabric, motion, trial, repeat):
        return math.nan if configuration == DIFFCP else 0.02

    rows = made_up_rows(some, fabrics=FABRICS[:2], repeats=1)
    found = [v for v in find(rows, {}) if "DiffCP explode" in v.claim.words][0]
    assert found.answer == "cannot be told" and found.claim.comparisons[0].p > 0.05
    assert "Diverged: 2 of 2 estimates of DiffCP, 0 of 14 others." in in_words(found)


@given(st.lists(st.floats(0, 1) | st.just(math.nan), max_size=8))
def test_holm(values):
    found = holm(values)
    known = [(v, f) for v, f in zip(values, found, strict=True) if not math.isnan(v)]
    assert all(f >= v and f <= 1 for v, f in known)
    assert all(math.isnan(f) == math.isnan(v) for v, f in zip(values, found, strict=True))
    ordered = sorted(known)
    assert all(a[1] <= b[1] for a, b in zip(ordered, ordered[1:], strict=False))
    if known:
        assert ordered[0][1] == pytest.approx(min(1, ordered[0][0] * len(known)))
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
