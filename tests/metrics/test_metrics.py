"""Distances of clouds, known by hand; where a recording would lie on a motion."""

import numpy as np
import pytest
from conftest import rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.metrics.prediction_error import (
    FARTHEST,
    TURN,
    Placement,
    best_placement,
    distances,
    paper_units,
    placed,
)

few = settings(max_examples=25, deadline=None)
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
UNIT = 0.5**0.5 / 2  # of the paper for `SQUARE`: half of the largest radius, [m]
scales = st.floats(1e-2, 1e2)
seeds = st.integers(0, 1000)


def clouds(seed):
    random = np.random.default_rng(seed)
    return random.normal(size=(20, 3)), random.normal(size=(15, 3))


def test_distances_by_hand():
    far = np.concatenate([SQUARE + [0, 0, 0.1], [[0.0, 0, 2.1]]])
    found = distances(SQUARE, far)
    assert found["chamfer_real_to_sim"] == pytest.approx(0.1)
    assert found["chamfer_sim_to_real"] == pytest.approx((4 * 0.1 + 2.1) / 5)
    assert found["chamfer"] == pytest.approx((0.1 + 0.5) / 2)
    assert found["hausdorff"] == pytest.approx(2.1)


@given(seeds, st.floats(-3, 3), st.integers(0, 2), scales)
@few
def test_distances_move_and_scale_with_the_clouds(seed, angle, axis, scale):
    one, other = clouds(seed)

    def move(cloud):
        return scale * (cloud @ np.asarray(rotation(angle, axis)).T + [3.0, -1.0, 2.0])

    expected = {name: scale * value for name, value in distances(one, other).items()}
    assert distances(move(one), move(other)) == pytest.approx(expected, rel=1e-9)


@given(scales, seeds)
@few
def test_paper_units_of_a_square_are_half_its_radius(scale, seed):
    place = np.random.default_rng(seed).normal(size=3)
    real, first = scale * SQUARE + place, scale * SQUARE
    # off its own first frame by 0.1 of the unit more than the real one, so by 0.1
    simulated = real + scale * UNIT * np.array([0, 0, 0.1])
    found = paper_units(real, simulated, first, first)
    assert found["paper_chamfer"] == pytest.approx(2 * 0.1**2, rel=1e-9)
    assert found["paper_hausdorff"] == pytest.approx(0.1, rel=1e-9)


def test_paper_units_centre_each_cloud_on_its_own_first_frame():
    shifted = SQUARE + [5.0, 0, 1]
    first = paper_units(SQUARE, shifted, SQUARE, shifted)
    assert first == pytest.approx({"paper_chamfer": 0, "paper_hausdorff": 0}, abs=1e-12)
    moved = paper_units(SQUARE, shifted + [0, 0, UNIT], SQUARE, shifted)
    assert moved == pytest.approx({"paper_chamfer": 2, "paper_hausdorff": 1})


BAD = {
    "empty": (np.zeros((0, 3)), "not empty"),
    "flat": (np.zeros((4, 2)), r"must be \(point, 3\)"),
    "not finite": (SQUARE + np.inf, "not finite"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_cloud_is_refused(name, unchecked):
    cloud, reason = BAD[name]
    with pytest.raises(ValueError, match=reason):
        distances(SQUARE, cloud)


def surface(count: int, seed: int) -> list[np.ndarray]:
    """Points of a bent sheet [m] in two frames of its motion."""
    u, v = np.random.default_rng(seed).uniform(-0.2, 0.2, (2, 2, count))
    return [
        np.stack([a, b, 0.3 + lift + 1.5 * a**2 + 1.0 * a * b], axis=1)
        for a, b, lift in zip(u, v, (0.0, 0.1), strict=True)
    ]


@pytest.mark.parametrize("shift, turn", [((0.0, 0.0, 0.0), 0.0), ((0.01, -0.02, 0.015), 0.1)])
def test_a_recording_that_was_moved_goes_back(shift, turn):
    true, motion = surface(500, 0), surface(20000, 1)
    away = Placement(np.array(shift), turn, np.mean(np.concatenate(true), axis=0))
    real = [placed(away, cloud) for cloud in true]
    place = best_placement(real, motion)
    back = [placed(place, cloud) for cloud in real]
    # what slides along the sheet moves it least
    np.testing.assert_allclose(np.concatenate(back)[:, 2], np.concatenate(true)[:, 2], atol=3e-3)
    assert np.abs(np.concatenate(back) - np.concatenate(true)).mean() < 3e-3


def test_a_turn_keeps_heights_and_distances():
    place = Placement(np.array([0.1, 0.2, 0.3]), 0.5, np.array([1.0, 2.0, 3.0]))
    cloud = np.random.default_rng(0).normal(size=(20, 3))
    there = placed(place, cloud)
    np.testing.assert_allclose(there[:, 2], cloud[:, 2] + 0.3)

    def lengths(points):
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    np.testing.assert_allclose(lengths(there), lengths(cloud), atol=1e-12)
    np.testing.assert_allclose(placed(place, place.pivot[None])[0], place.pivot + place.shift)


def test_a_recording_is_not_placed_beyond_what_may_be_in_doubt():
    motion = surface(5000, 1)
    place = best_placement([cloud + np.array([0.0, 0.0, 0.2]) for cloud in surface(500, 0)], motion)
    assert np.max(np.abs(place.shift)) <= FARTHEST and abs(place.turn) <= TURN
    assert place.shift[2] == pytest.approx(-FARTHEST, rel=1e-3)
