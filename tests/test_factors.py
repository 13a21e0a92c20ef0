"""Shares of the variance: right on made-up data whose shares are known."""

import itertools
import math

import numpy as np
import pytest
from made_up_study import made_up_rows

from r2s.study.configuration import PAPER_CONFIGURATIONS, Configuration
from r2s.study.statistics.factors import share_table, variance_shares
from r2s.study.statistics.result_array import result_array

CROSSED = tuple(
    Configuration(*names)
    for names in itertools.product(("a", "b", "c"), ("cloth", "points"), ("lifting", "wind"))
)
FABRICS = tuple(f"fabric_{i}" for i in range(6))


def shares(rows, motions=("fling",)):
    found = variance_shares(result_array(rows, "chamfer", motions))
    assert found is not None
    return found, dict(zip(found.factors, found.share, strict=True))


def effects(generator, levels, variance):
    """One number a level, whose variance over the levels is as given."""
    drawn = generator.normal(size=len(levels))
    drawn = (drawn - drawn.mean()) / drawn.std()
    return dict(zip(levels, math.sqrt(variance) * drawn, strict=True))


def test_known_shares_are_found():
    generator = np.random.default_rng(0)
    wanted = {
        "approach": 0.03,
        "solver": 0.02,
        "scenario": 0.01,
        "fabric": 0.04,
        "trajectory": 0.06,
    }
    by = {
        "approach": effects(generator, "abc", wanted["approach"]),
        "solver": effects(generator, ("cloth", "points"), wanted["solver"]),
        "scenario": effects(generator, ("lifting", "wind"), wanted["scenario"]),
        "fabric": effects(generator, FABRICS, wanted["fabric"]),
    }
    trajectory = {f: effects(generator, range(1, 13), wanted["trajectory"]) for f in FABRICS}

    def distance(configuration, fabric, motion, trial, repeat):
        parts = zip(("approach", "solver", "scenario"), configuration, strict=True)
        total = sum(by[name][level] for name, level in parts)
        return 0.02 * math.exp(total + by["fabric"][fabric] + trajectory[fabric][trial])

    rows = made_up_rows(distance, CROSSED, FABRICS, ["fling"], trials=12, noise=0.2)
    found, share = shares(rows)
    total = sum(wanted.values()) + 0.2**2
    for name, variance in wanted.items():
        assert share[name] == pytest.approx(variance / total, abs=0.02)
    assert share["rest"] == pytest.approx(0.2**2 / total, abs=0.02)
    assert found.share.sum() == pytest.approx(1)
    assert found.confounded == () and found.diverged == 0
    table = share_table({"fling": found, "again": found}, "")
    assert table.header == ("factor", "fling [%]", "again [%]") and table.rows[-1][0] == "rest"
    assert table.rows[0][1] == f"{100 * share['approach']:.1f}"


def test_factors_without_effect_have_no_share():
    found, share = shares(
        made_up_rows(configurations=CROSSED, fabrics=FABRICS, trials=10, repeats=3)
    )
    assert all(abs(value) < 0.02 for name, value in share.items() if name != "rest")
    assert share["rest"] == pytest.approx(1, abs=0.02)
    assert found.deviation == pytest.approx(0.1, rel=0.1)


def test_confounded_factors_share_what_cannot_be_told_apart():
    # The fourth approach comes from stretching, and nothing else does.
    configurations = [Configuration(a, "cloth", s) for a in "abc" for s in ("lifting", "wind")]
    configurations += [Configuration("pinn", "cloth", "stretching")]

    def distance(configuration, *_):
        return 0.02 * (2 if configuration.approach == "pinn" else 1)

    rows = made_up_rows(distance, configurations, trials=6, noise=0.05)
    found, share = shares(rows)
    assert share["approach"] == pytest.approx(share["scenario"], abs=0.02)
    assert share["approach"] + share["scenario"] > 0.9
    assert ("approach", "scenario") in found.confounded
    assert "approach and scenario" in share_table({"fling": found}, "").caption


def test_what_depends_on_one_alone_is_its_own_even_when_the_design_is_not_balanced():
    def distance(configuration, *_):
        return 0.02 * (2 if configuration.solver == "points" else 1)

    found, share = shares(made_up_rows(distance, trials=6, noise=0.02))
    assert share["solver"] == max(share.values()) and share["solver"] > 0.6
    assert found.share.sum() == pytest.approx(1)


def test_motions_count_together_with_the_others():
    def distance(configuration, fabric, motion, *_):
        return 0.02 * (3 if motion == "fling" else 1)

    _, share = shares(made_up_rows(distance, trials=4), ("folding", "fling"))
    assert share["motion"] > 0.9


def test_what_diverged_is_counted():
    def distance(configuration, f, m, trial, r):
        return math.nan if trial == 2 else 0.02

    found, _ = shares(made_up_rows(distance, PAPER_CONFIGURATIONS[:2], noise=0.1, trials=5))
    assert (found.count, found.diverged) == (48, 12)
    assert "48 on fling" in share_table({"fling": found}, "").caption
    assert "12 more diverged" in share_table({"fling": found}, "").caption


def test_too_little_to_tell():
    assert variance_shares(result_array([], "chamfer")) is None
    constant = made_up_rows(noise=0.0)
    assert variance_shares(result_array(constant, "chamfer")) is None
