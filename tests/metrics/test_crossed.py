"""Means over units that share the levels of other factors: what they are uncertain by."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from r2s.metrics.statistics import POWER, crossed_mean, interval, p_value, units_needed


def test_without_other_factors_it_is_students_t():
    numbers = np.array([0.3, 0.1, -0.1, 0.4])
    found = crossed_mean(numbers)
    theirs: Any = stats.ttest_1samp(numbers, 0.0)
    assert p_value(found) == pytest.approx(theirs.pvalue)
    low, high = theirs.confidence_interval(0.9)
    assert interval(found) == pytest.approx((low, high))
    assert found.freedom == 3 and found.shared == 0


def test_what_all_units_share_is_seen_in_the_levels_alone():
    """Units that are alike say nothing of the motions, which make all of the uncertainty."""
    of_level = np.array([0.5, -0.2, 0.1, 0.3])
    table = np.tile(of_level, (3, 1))
    found = crossed_mean(table.mean(axis=1), [table])
    assert found.spread == pytest.approx(0, abs=1e-12)
    assert found.error == pytest.approx(of_level.std(ddof=1) / 2)
    assert found.freedom == pytest.approx(3)


def test_the_variance_of_the_mean_is_right_on_average():
    generator, units, levels = np.random.default_rng(0), 4, 5
    errors, means = [], []
    for _ in range(3000):
        table = 0.3 * generator.normal(size=(units, 1)) + 0.4 * generator.normal(size=(1, levels))
        table = table + 0.2 * generator.normal(size=(units, levels))
        found = crossed_mean(table.mean(axis=1), [table])
        errors.append(found.error**2)
        means.append(found.mean)
    expected = 0.3**2 / units + 0.4**2 / levels + 0.2**2 / (units * levels)
    assert np.var(means) == pytest.approx(expected, rel=0.08)
    # The interaction is in what units vary by, and taken out of what levels do.
    assert np.mean(errors) == pytest.approx(expected, rel=0.08)


def test_one_unit_has_no_interval():
    found = crossed_mean(np.array([0.3]))
    assert found.mean == 0.3 and math.isnan(p_value(found))
    assert all(math.isnan(x) for x in (*interval(found), *units_needed(found, 0.3, 0.05)))
    assert math.isnan(crossed_mean(np.zeros(0)).mean)


def test_units_needed_have_the_power_and_one_less_does_not():
    found = crossed_mean(np.array([0.1, 0.5, 0.3]))
    likely, fewest, most = units_needed(found, 0.3, 0.05)
    assert fewest <= likely < most
    generator = np.random.default_rng(1)
    for count, is_enough in ((int(likely), True), (int(likely) - 1, False)):
        drawn = 0.3 + found.spread * generator.normal(size=(40000, count))
        tested: Any = stats.ttest_1samp(drawn, 0.0, axis=1)
        power = np.mean(tested.pvalue < 0.05)
        assert (power > POWER - 0.01) == is_enough, (count, power)


def test_what_units_share_no_number_of_them_tells():
    table = np.tile(np.array([1.0, -1.0]), (3, 1)) + 0.1
    found = crossed_mean(np.array([0.05, 0.1, 0.15]), [table])
    assert units_needed(found, 0.1, 0.05)[0] == math.inf
    assert units_needed(found._replace(shared=0.0), 0.1, 0.05)[0] < 20
