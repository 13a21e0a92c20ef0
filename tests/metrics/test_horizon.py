"""Floors, horizons and skills; distances to surfaces; what does not depend on the phase."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import r2s
from r2s.mesh.surface import sample
from r2s.metrics import horizon
from r2s.metrics.horizon import floor_of, horizon_of, skill, within
from r2s.metrics.losses import POINTS, to_surface

TIMES = np.arange(20) / 10


def test_independent_causes_add_as_squares_and_a_member_that_diverged_ends_the_floor():
    causes = {"mesh": np.full((1, 20), 3e-3), "stiffness": np.array([[2e-3], [6e-3]]) * np.ones(20)}
    assert floor_of(causes) == pytest.approx(np.full(20, 5e-3))
    causes["mesh"][0, 7] = np.nan
    assert np.isinf(floor_of(causes)).tolist() == [i == 7 for i in range(20)]
    with pytest.raises(ValueError, match="a cause"):
        floor_of({})


def test_a_floor_that_doubles_in_a_time_has_its_horizon_where_it_passes_the_share():
    floor = 1e-3 * 2 ** (TIMES / 0.5)  # 16 mm after 2 s
    apart = np.full((3, 20), 16e-3)
    assert horizon_of(TIMES, floor, apart) == pytest.approx(1.6)  # above 8 mm after 1.5 s
    assert np.isinf(horizon_of(TIMES, floor, 10 * apart))
    assert horizon_of(TIMES, floor, apart / 100) == 0.0
    assert within(TIMES, 1.6).sum() == 16


def test_skill_is_one_at_the_floor_and_is_not_told_where_the_default_is_no_worse():
    assert skill(2e-3, 10e-3, 2e-3) == pytest.approx(1)
    assert skill(10e-3, 10e-3, 2e-3) == pytest.approx(0)
    assert skill(14e-3, 10e-3, 2e-3) == pytest.approx(-0.5)
    assert np.isnan(skill(2e-3, 2.9e-3, 2e-3)) and np.isnan(skill(2e-3, np.nan, 2e-3))
    for default in (10e-3, 2e-3, np.nan):  # a run that diverged never helps
        assert skill(np.nan, default, 2e-3) == -np.inf


def test_points_of_a_sheet_are_at_no_distance_from_it_and_others_at_their_own():
    mesh = r2s.rectangle((0.4, 0.3), (5, 4))
    flat = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)))
    bent = flat + np.stack([0 * flat[:, 0], 0 * flat[:, 0], 0.3 * flat[:, 0] ** 2], axis=1)
    points = np.asarray(sample(jnp.asarray(bent), mesh.faces, 8))
    chosen = np.asarray(jr.permutation(jr.key(0), points))
    above = chosen[: POINTS // 4] * [1, 1, 0] + [0, 0, 7e-3]
    x = np.stack([bent, flat, np.nan * flat])
    found = to_surface([chosen, above, chosen], x, mesh.faces)
    assert found[:2] == pytest.approx([0, 7e-3], abs=1e-9) and np.isnan(found[2])
    with pytest.raises(ValueError, match="frame 1 has no points"):
        to_surface([chosen, chosen[:0], chosen], x, mesh.faces)


def swing(phase: float) -> list[np.ndarray]:
    """A plate of 0.2 m x 0.1 m that swings with an amplitude of 0.05 m at 1 Hz, for 4 s."""
    grid = np.stack(np.meshgrid(np.linspace(0, 0.2, 9), np.linspace(0, 0.1, 5)), -1).reshape(-1, 2)
    plate = np.pad(grid, ((0, 0), (0, 1)))
    times = np.arange(80) / 20
    return [plate + [0.05 * np.sin(2 * np.pi * t + phase), 0, 0] for t in times]


def test_the_phase_of_a_swing_does_not_count_but_its_size_and_speed_do():
    times = np.arange(80) / 20
    found = horizon.features(swing(0.0), times)
    assert found["width"] == pytest.approx(0.2) and found["height"] == 0
    assert found["area"] == pytest.approx(0.02)
    assert found["speed"] == pytest.approx(0.05 * 2 * np.pi / np.sqrt(2), rel=0.02)
    assert found["frequency"] == pytest.approx(1, rel=0.03)
    apart = horizon.differences(swing(0.0), swing(1.0), times)
    assert apart["speed"] < 0.02 * found["speed"] and apart["frequency"] < 0.05
    larger = [2 * cloud for cloud in swing(0.0)]
    twice = horizon.differences(swing(0.0), larger, times)
    assert twice["width"] == pytest.approx(0.2) and twice["area"] == pytest.approx(0.06)
    assert twice["speed"] == pytest.approx(found["speed"])
    assert np.isnan(horizon.differences(swing(0.0), [np.nan * c for c in larger], times)["sag"])
    with pytest.raises(ValueError, match="must increase"):
        horizon.features(swing(0.0), -times)
    kept = np.arange(80) % 3 != 2  # every third frame dropped
    some = horizon.features([c for c, k in zip(swing(0.0), kept, strict=True) if k], times[kept])
    for name, value in found.items():
        assert some[name] == pytest.approx(value, rel=0.03), name
