"""Ranks of configurations and shares of factors in made-up studies that are known."""

import itertools
import math

import numpy as np
import pytest
from made_up_study import made_up_results
from scipy import stats

from r2s.study.configuration import PAPER_CONFIGURATIONS, Configuration
from r2s.study.statistics.factors import variance_shares
from r2s.study.statistics.ranks import critical_difference, rank

CROSSED = tuple(
    Configuration(*names)
    for names in itertools.product(("a", "b", "c"), ("cloth", "points"), ("lifting", "wind"))
)
FABRICS = tuple(f"fabric_{i}" for i in range(6))


def made_up(distance=lambda *_: 0.02, motions=("fling",), **more):
    return made_up_results(distance, metrics=["chamfer"], motions=motions, **more)


def test_ranks_do_not_see_how_hard_a_recording_is():
    def ordered(configuration, fabric, motion, trial, repeat):
        return 0.01 * (1 + PAPER_CONFIGURATIONS.index(configuration)) * trial**3

    found = rank(made_up(ordered, noise=0.0))
    assert found is not None and (found.recordings, found.fabrics) == (12, 3)
    labels = [each.label for each in PAPER_CONFIGURATIONS]
    assert np.all(np.diff(found.table["mean"][labels]) > 0)
    assert np.all(found.table.low <= found.table.high)
    assert found.p < 0.01 and found.table["first"].sum() == pytest.approx(1)
    # the default, 40 mm, is first only where recordings are hard
    assert found.table.index[0] == "DIFFCLOUD cloth lifting"


def test_what_diverged_is_last():
    def some(configuration, f, m, trial, repeat):
        return math.nan if configuration.approach == "diffcp" and repeat == 2 else 0.02

    found = rank(made_up(some))
    assert found is not None
    assert found.table["mean"]["DiffCP points lifting"] == len(found.table)


def test_what_is_judged_on_less_than_half_is_left_out():
    results = made_up()
    results = results[(results.approach != "diffcp") | (results.fabric == "pink_solid")]
    is_lost = (results.approach == "pinn") & results.recording.str.endswith("denim1")
    found = rank(results[~is_lost])
    assert found is not None
    assert found.left_out == ["DiffCP points lifting"] and found.recordings == 11


def test_alike_configurations_are_not_told_apart():
    found = [rank(made_up(seed=seed, repeats=1)) for seed in range(20)]
    p = [each.p for each in found if each is not None]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_too_little_to_rank():
    results = made_up(configurations=PAPER_CONFIGURATIONS[:1])
    assert rank(results[:0]) is None
    assert rank(results[results.baseline == ""]) is None
    two = rank(made_up(configurations=PAPER_CONFIGURATIONS[:2]))
    assert two is not None and math.isnan(two.p)


def test_critical_difference_is_that_of_the_tables():
    # Demsar 2006, table 5: q = 2.343 for 3 configurations, 3.164 for 10.
    assert critical_difference(3, 30) == pytest.approx(2.343 * math.sqrt(12 / 180), rel=1e-3)
    assert critical_difference(10, 14) == pytest.approx(3.164 * math.sqrt(110 / 84), rel=1e-3)


def shares(results):
    found = variance_shares(results)
    assert found is not None
    return found.set_index("factor")


def test_known_shares_of_the_variance_are_found():
    wanted = {"approach": 0.03, "solver": 0.02, "estimated_from": 0.01, "fabric": 0.04}
    generator = np.random.default_rng(0)
    levels = dict(
        zip(wanted, ("abc", ("cloth", "points"), ("lifting", "wind"), FABRICS), strict=True)
    )
    effects = {}
    for name, variance in wanted.items():
        drawn = stats.zscore(generator.normal(size=len(levels[name])))
        effects[name] = dict(zip(levels[name], math.sqrt(variance) * drawn, strict=True))

    def distance(configuration, fabric, *_):
        named = configuration._asdict() | {"fabric": fabric}
        return 0.02 * math.exp(sum(effects[name][named[name]] for name in wanted))

    found = shares(made_up(distance, configurations=CROSSED, fabrics=FABRICS, trials=12, repeats=1,
                           noise=0.2))  # fmt: skip
    total = sum(wanted.values()) + 0.2**2
    for name, variance in wanted.items():  # of a design that is crossed in full both are the same
        assert found.alone[name] == pytest.approx(variance / total, abs=0.02)
        assert found.added[name] == pytest.approx(variance / total, abs=0.02)
    assert found.alone["all"] == pytest.approx(1 - 0.2**2 / total, abs=0.02)


def test_factors_without_effect_have_no_share():
    found = shares(made_up(configurations=CROSSED, fabrics=FABRICS, trials=10))
    assert np.abs(found).to_numpy().max() < 0.02


def test_confounded_factors_explain_much_alone_and_add_nothing_to_each_other():
    # The fourth approach comes from stretching, and nothing else does.
    configurations = [Configuration(a, "cloth", s) for a in "abc" for s in ("lifting", "wind")]
    configurations += [Configuration("pinn", "cloth", "stretching")]

    def distance(configuration, *_):
        return 0.02 * (2 if configuration.approach == "pinn" else 1)

    found = shares(made_up(distance, configurations=configurations, trials=6, noise=0.05))
    for name in ("approach", "estimated_from"):
        assert found.alone[name] > 0.9 and abs(found.added[name]) < 0.02


def test_too_little_to_share():
    assert variance_shares(made_up()[:0]) is None
    assert variance_shares(made_up(noise=0.0)) is None
