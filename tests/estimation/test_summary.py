"""What an estimate says: intervals, narrowing, correlations, and what to record next."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.estimate import Estimate, as_json, from_json, point_estimate
from r2s.estimation.summary import next_recording
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace, Range

FABRIC = presets.grey_interlock()


def test_intervals_narrowing_and_correlations_are_those_of_the_covariance():
    """Two parameters of which only the ratio is known, and a third that is known alone."""
    ranges = (
        Range("a", "N/m", 1.0, 100.0),
        Range("b", "N/m", 1.0, 100.0),
        Range("c", "-", -0.9, 0.9, log=False),
    )
    spread, ratio = 0.5, 0.01
    covariance = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]]) * spread**2
    covariance += np.diag([ratio**2 / 2, ratio**2 / 2, 1e-4])
    deviation = np.sqrt(np.diag(covariance))
    found = Estimate(
        "test", FABRIC, ranges, np.array([8.0, 2.0, 0.1]), deviation,
        covariance / np.outer(deviation, deviation), (), 0.0, np.zeros((1, 1)),
        np.zeros((1, 1, 3)), 0.0, None,
    )  # fmt: skip
    factor = np.exp(1.645 * deviation[0])
    expected = [[8 / factor, 8 * factor], [1.0, 2 * factor], [0.1 - 0.01645, 0.1 + 0.01645]]
    assert found.intervals == pytest.approx(np.array(expected))  # b's is cut at its range
    uniform = 1 / np.sqrt(12)
    assert found.narrowing == pytest.approx(
        [spread / (np.log(100) * uniform)] * 2 + [0.01 / (1.8 * uniform)], rel=0.01
    )
    (one, other, r), *_ = found.correlated()
    assert {one, other} == {"a", "b"} and r == pytest.approx(1, abs=1e-3)
    known = dataclasses.replace(found, prior_errors=2 * deviation)
    assert known.narrowing == pytest.approx([0.5] * 3)
    assert from_json(as_json(known)).narrowing == pytest.approx([0.5] * 3)


def test_the_next_recording_is_that_of_what_is_narrowed_least():
    space = OrthotropicSpace.make(0.2)
    place, none = jnp.full(space.dim, 0.5), np.zeros((1, 1))
    found = point_estimate("any", space, place, 0.0, none, none[None], 0.0)
    assert next_recording(found) == []  # without standard errors nobody knows
    widths = np.array([bound.width for bound in space.ranges])
    for number, words in ((0, "stretchings"), (4, "cantilever"), (5, "fling"), (6, "table")):
        errors = 0.01 * widths
        errors[number] = widths[number]
        errors[:4] = errors[number] if number == 0 else errors[:4]
        (line,) = next_recording(dataclasses.replace(found, standard_errors=errors))
        first, _ = line.split("; then ")
        assert words in first and space.ranges[number].name in first
