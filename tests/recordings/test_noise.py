"""Noise of clouds from the clouds alone: that of a plane, of a bent sheet, of too few points."""

import numpy as np
import pytest
from test_recording import record

from r2s.recordings.noise import mean_distance, point_noise

RNG = np.random.default_rng(0)


def clouds(noise: float, radius: float = 1e3, count: int = 2000) -> list[np.ndarray]:
    """Frames of a sheet of 0.2 m on a cylinder [m], with noise [m] across it."""
    along, across = RNG.uniform(0, 0.2, (2, 6, count))
    away, angle = noise * RNG.standard_normal((6, count)), along / radius
    out = radius + away
    return list(np.stack([out * np.sin(angle), across, out * np.cos(angle) - radius], axis=2))


@pytest.mark.parametrize("noise", [2e-4, 1e-3, 3e-3])
def test_noise_across_a_plane_is_found(noise):
    assert point_noise(record(clouds(noise))) == pytest.approx(noise, rel=0.2)


def test_a_fold_of_5_cm_hardly_counts_as_noise():
    assert point_noise(record(clouds(1e-3, radius=0.05))) == pytest.approx(1e-3, rel=0.2)


def test_of_too_few_points_nothing_is_known():
    assert np.isnan(point_noise(record(clouds(1e-3, count=9))))


def test_the_mean_distance_is_that_of_normal_noise():
    assert mean_distance(1.0) == pytest.approx(
        np.abs(RNG.standard_normal(100_000)).mean(), rel=0.01
    )
