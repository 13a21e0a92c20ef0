"""Ranks of configurations and shares of factors in made-up studies that are known."""

import math

import numpy as np
import pytest
from made_up_study import made_up_results
from scipy import stats

from r2s.study.configuration import PAPER_CONFIGURATIONS
from r2s.study.statistics.comparisons import critical_difference, rank


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
    assert found.table["mean"]["DiffCP mpm lifting"] == len(found.table)


def test_what_is_judged_on_less_than_half_is_left_out():
    results = made_up()
    results = results[(results.approach != "diffcp") | (results.fabric == "pink_solid")]
    is_lost = (results.approach == "pinn") & results.recording.str.endswith("denim1")
    found = rank(results[~is_lost])
    assert found is not None
    assert found.left_out == ["DiffCP mpm lifting"] and found.recordings == 11


def test_alike_configurations_are_not_told_apart():
    found = [rank(made_up(seed=seed, repeats=1)) for seed in range(20)]
    p = [each.p for each in found if each is not None]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_critical_difference_is_that_of_the_tables():
    # Demsar 2006, table 5: q = 2.343 for 3 configurations, 3.164 for 10.
    assert critical_difference(3, 30) == pytest.approx(2.343 * math.sqrt(12 / 180), rel=1e-3)
    assert critical_difference(10, 14) == pytest.approx(3.164 * math.sqrt(110 / 84), rel=1e-3)
