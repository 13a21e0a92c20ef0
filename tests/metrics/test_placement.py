"""Where a recording would have to be for it to lie on a motion."""

import numpy as np
import pytest

from r2s.metrics.prediction_error import FARTHEST, TURN, Placement, best_placement, placed


def surface(count: int, seed: int) -> list[np.ndarray]:
    """Points of a bent sheet [m] in two frames of its motion."""
    u, v = np.random.default_rng(seed).uniform(-0.2, 0.2, (2, 2, count))
    return [
        np.stack([a, b, 0.3 + lift + 1.5 * a**2 + 1.0 * a * b], axis=1)
        for a, b, lift in zip(u, v, (0.0, 0.1), strict=True)
    ]


@pytest.mark.parametrize("shift, turn", [((0.0, 0.0, 0.0), 0.0), ((0.01, -0.02, 0.015), 0.1)])
def test_a_recording_that_was_moved_goes_back(shift, turn) -> None:
    true, motion = surface(500, 0), surface(20000, 1)
    away = Placement(np.array(shift), turn, np.mean(np.concatenate(true), axis=0))
    real = [placed(away, cloud) for cloud in true]
    place = best_placement(real, motion)
    back = [placed(place, cloud) for cloud in real]
    # what slides along the sheet moves it least
    np.testing.assert_allclose(np.concatenate(back)[:, 2], np.concatenate(true)[:, 2], atol=3e-3)
    assert np.abs(np.concatenate(back) - np.concatenate(true)).mean() < 3e-3


def test_a_turn_keeps_heights_and_distances() -> None:
    place = Placement(np.array([0.1, 0.2, 0.3]), 0.5, np.array([1.0, 2.0, 3.0]))
    cloud = np.random.default_rng(0).normal(size=(20, 3))
    there = placed(place, cloud)
    np.testing.assert_allclose(there[:, 2], cloud[:, 2] + 0.3)

    def lengths(points):
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    np.testing.assert_allclose(lengths(there), lengths(cloud), atol=1e-12)
    np.testing.assert_allclose(placed(place, place.pivot[None])[0], place.pivot + place.shift)


def test_a_recording_is_not_placed_beyond_what_may_be_in_doubt() -> None:
    motion = surface(5000, 1)
    place = best_placement([cloud + np.array([0.0, 0.0, 0.2]) for cloud in surface(500, 0)], motion)
    assert np.max(np.abs(place.shift)) <= FARTHEST and abs(place.turn) <= TURN
    assert place.shift[2] == pytest.approx(-FARTHEST, rel=1e-3)
