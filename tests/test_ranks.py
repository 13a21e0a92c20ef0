"""Ranks of configurations, and Friedman's test of them."""

import math

import numpy as np
import pytest
from made_up_study import made_up_rows
from scipy import stats

from r2s.evaluation.statistics import critical_difference
from r2s.study.configuration import PAPER_CONFIGURATIONS
from r2s.study.statistics.ranks import rank, rank_table
from r2s.study.statistics.result_array import result_array


def ordered(configuration, fabric, motion, trial, repeat):
    """Distances that grow with the place of the configuration, on trajectories that differ."""
    return 0.01 * (1 + PAPER_CONFIGURATIONS.index(configuration)) * trial**3


def test_ranks_do_not_see_how_hard_a_trajectory_is():
    found = rank(result_array(made_up_rows(ordered, noise=0.0), "chamfer", ("fling",)))
    assert found is not None and found.trajectories == 12
    # The default, 40 mm, is first only where trajectories are hard.
    estimates = found.mean[: len(PAPER_CONFIGURATIONS)]
    assert np.all(np.diff(estimates) > 0) and np.all(found.low <= found.high)
    assert found.test.p < 0.01 and found.test.blocks == found.fabrics == 3
    assert found.first.sum() == pytest.approx(1)
    shown = rank_table({"fling": found}, "Ranks")
    assert (
        shown.header == ("configuration", "fling")
        and "Fling: 9 configurations, 12 tra" in shown.caption
    )
    assert shown.rows[0][0] == "DIFFCLOUD cloth lifting" and "Friedman" in shown.caption
    assert shown.rows[0][1].startswith(f"{found.mean[0]:.2f} [")


def test_what_diverged_is_last():
    def some(configuration, f, m, trial, repeat):
        return math.nan if configuration.approach == "diffcp" and repeat == 2 else 0.02

    found = rank(result_array(made_up_rows(some), "chamfer", ("fling",)))
    assert found is not None
    assert found.mean[PAPER_CONFIGURATIONS.index(("diffcp", "points", "lifting"))] == len(
        found.configurations
    )


def test_what_is_judged_on_less_than_half_is_left_out():
    rows = [r for r in made_up_rows() if r.approach != "diffcp" or r.fabric == "pink_solid"]
    rows = [r for r in rows if r.approach != "pinn" or not r.recording.endswith("denim1")]
    found = rank(result_array(rows, "chamfer", ("fling",)))
    assert found is not None
    assert [configuration.approach for configuration in found.left_out] == ["diffcp"]
    assert found.trajectories == 11 and "left out" in rank_table({"fling": found}, "").caption


def test_alike_columns_are_not_told_apart():
    p = []
    for seed in range(20):
        found = rank(result_array(made_up_rows(seed=seed, repeats=1), "chamfer", ("fling",)))
        assert found is not None
        p.append(found.test.p)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_too_little_to_rank():
    assert rank(result_array([], "chamfer")) is None
    one = [r for r in made_up_rows(configurations=PAPER_CONFIGURATIONS[:1]) if not r.baseline]
    assert rank(result_array(one, "chamfer")) is None
    two = rank(result_array(made_up_rows(configurations=PAPER_CONFIGURATIONS[:2]), "chamfer"))
    assert two is not None and math.isnan(two.test.p)
    assert "cannot be made" in rank_table({"fling": two}, "").caption


def test_critical_difference_is_that_of_the_tables():
    # Demsar 2006, table 5: q = 2.343 for 3 configurations, 3.164 for 10.
    assert critical_difference(3, 30) == pytest.approx(2.343 * math.sqrt(12 / 180), rel=1e-3)
    assert critical_difference(10, 14) == pytest.approx(3.164 * math.sqrt(110 / 84), rel=1e-3)
