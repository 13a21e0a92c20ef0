"""Conclusions are told right where made-up rows make them true, false or unclear."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_study import FABRICS, few_draws, made_up_rows
from scipy.stats import kstest

from r2s.evaluation.statistics import holm, signed_rank
from r2s.study.configuration import PAPER_CONFIGURATIONS
from r2s.study.statistics.conclusions import CONCLUSIONS
from r2s.study.statistics.findings import find, finding_table, in_words
from r2s.study.statistics.hypotheses import Claim, compare, judge
from r2s.study.statistics.result_array import result_array, select

DIFFCLOUD_L, DIFFCLOUD_W, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]


@pytest.fixture(scope="module", autouse=True)
def quick():
    with few_draws():
        yield


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
    if configuration.approach == "physnet":
        value *= math.exp(0.4 * (-1) ** repeat)
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


@pytest.fixture(scope="module")
def right():
    return find(made_up_rows(as_concluded, trials=6, repeats=3), {})


def answers(verdicts):
    return dict(zip((f.__name__ for f in CONCLUSIONS), (v.answer for v in verdicts), strict=True))


def test_conclusions_that_are_right_hold(right):
    found = answers(right)
    # DiffCP diverges: that is further from its own repeats than PhysNet is.
    assert found.pop("physnet_varies_most") != "holds"
    assert set(found.values()) == {"holds"}
    without = [r for r in made_up_rows(as_concluded, trials=6, repeats=3) if r.approach != "diffcp"]
    assert answers(find(without, {}))["physnet_varies_most"] == "holds"


def test_conclusions_that_are_wrong_do_not():
    found = answers(find(made_up_rows(reversed_of, trials=6, repeats=2), {}))
    assert found.pop("diffcp_explodes") == "cannot be told"  # none diverged
    assert set(found.values()) == {"does not hold"}


def test_what_is_alike_does_not_hold_and_what_is_unclear_is_not_told():
    results = result_array(made_up_rows(noise=0.02, trials=20), "chamfer", ("fling",))
    alike = compare("", results, [DIFFCLOUD_L], [DIFFCLOUD_W])
    few = select(
        result_array(made_up_rows(noise=0.4), "chamfer"), trajectories=lambda t: t[0] == FABRICS[0]
    )
    unclear = compare("", few, [DIFFCLOUD_L], [DIFFCLOUD_W])
    found = [verdict.answer for verdict in judge([Claim("", (alike,)), Claim("", (unclear,))])]
    assert found == ["does not hold", "cannot be told"]


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


def test_a_diverged_side_counts_against_it():
    def some(configuration, *_):
        return math.nan if configuration == DIFFCLOUD_W else 0.02

    results = result_array(made_up_rows(some), "chamfer", ("fling",))
    found = compare("", results, [DIFFCLOUD_L], [DIFFCLOUD_W])
    assert found.favoured and found.p < 1e-3 and math.isnan(found.ratio) and found.diverged == 12
    both = compare("", results, [DIFFCLOUD_W], [DIFFCLOUD_W])
    assert both.p == 1


def test_wilcoxon_of_pairs():
    p, favoured = signed_rank(np.array([1.0, 2.0, 3.0, 4.0, np.inf]))
    assert (p, favoured) == (2 / 2**5, True)  # all of the signs alike: two of 32 orders
    assert signed_rank(np.zeros(5)) == (1.0, False)


def test_trajectories_of_alike_columns_give_uniform_p():
    p = []
    for seed in range(60):
        rows = made_up_rows(configurations=[DIFFCLOUD_L, DIFFCLOUD_W], repeats=1, seed=seed)
        p.append(compare("", result_array(rows, "chamfer"), [DIFFCLOUD_L], [DIFFCLOUD_W]).p)
    assert 2 <= sum(value < 0.1 for value in p) <= 12  # 6 expected
    assert kstest(p, "uniform").pvalue > 0.05


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
