"""Gripper paths: smooth, at rest at both ends, within their limits."""

import math

import jax.random as jr
import numpy as np
import pytest

from r2s.recordings.recording import corner
from r2s.scenarios import paths
from r2s.scenarios.standard import ALL_CORNERS, SCENARIOS, hanging, on_table, varied, wind

DURATION = 59 / 15  # [s]
SIZE = (0.3, 0.2)  # [m]


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_path_is_smooth_and_at_rest_at_both_ends(name):
    for experiment in (SCENARIOS[name](), *varied(name, 5, key=jr.key(0))):
        times, path = experiment.route
        rate = 1 / np.diff(times)[:, None, None]
        velocity = np.diff(path, axis=0) * rate
        assert times[0] == 0 and times[-1] == experiment.times[-1]
        # a knot is 1 / 120 s: at rest means one acceleration times that
        assert np.abs(velocity[[0, -1]]).max() < 20 / 120
        assert np.abs(np.diff(velocity, axis=0)).max() < 20 / 120  # [m/s], of 20 m/s^2
        assert np.linalg.norm(velocity, axis=-1).max() < 2.5


@pytest.mark.parametrize("held", ["origin", "warp", "weft", "opposite"])
def test_any_corner_can_be_folded_onto_the_opposite_one(held):
    sheet = on_table(SIZE, (held,))
    path = paths.fold_path(sheet, DURATION, reach=1.0).path[:, 0]
    np.testing.assert_allclose(path[0], corner(sheet, held), atol=1e-12)
    there = corner(sheet, paths.OPPOSITE[held])
    np.testing.assert_allclose(path[-1, :2], there[:2], atol=1e-12)
    assert path[:, 2].min() >= sheet.origin[2] - 1e-12
    assert path[-1, 2] == pytest.approx(sheet.origin[2] + paths.TABLE_GAP)


def test_a_lift_goes_up_and_inward():
    path = paths.lift_path(on_table(SIZE, ("weft",)), DURATION, height=0.3, inward=0.1).path
    moved = path[-1, 0] - path[0, 0]
    assert moved[2] == pytest.approx(0.3)
    assert np.linalg.norm(moved[:2]) == pytest.approx(0.1)
    assert moved[0] > 0 > moved[1]  # from the end of the weft towards the end of the warp


def test_a_pull_moves_one_clamp_by_its_strain():
    path = paths.pull_path(on_table(SIZE, ALL_CORNERS), DURATION, strain=0.05).path
    moved = path[-1] - path[0]
    np.testing.assert_allclose(moved[:, 0], [0, 0, 0.05 * SIZE[0], 0.05 * SIZE[0]], atol=1e-12)
    np.testing.assert_array_equal(moved[:, 1:], 0)


def test_a_fling_comes_back_and_a_shake_moves_one_gripper():
    sheet = hanging(SIZE, 0.5)
    flung = paths.fling_path(sheet, DURATION, forward=0.3).path
    away = flung - flung[:1]
    assert away[..., 1].max() == pytest.approx(0.3, rel=1e-3)
    np.testing.assert_allclose(away[-1], 0, atol=1e-12)
    shaken = paths.shake_path(sheet, DURATION, amplitude=0.05, frequency=1.5).path
    away = shaken - shaken[:1]
    np.testing.assert_array_equal(away[:, 0], 0)
    assert np.abs(away[:, 1, 2]).max() == pytest.approx(0.05, rel=0.02)
    risen = np.diff(np.sign(away[:, 1, 2][np.abs(away[:, 1, 2]) > 1e-3]))
    assert np.sum(risen != 0) == pytest.approx(2 * 1.5 * (DURATION - 0.5), abs=1.5)


@pytest.mark.parametrize("name", SCENARIOS)
def test_drawn_numbers_keep_their_limits_and_their_seed(name):
    drawn = paths.draw(name, paths.EVALUATION, key=jr.key(1))
    assert drawn == paths.draw(name, paths.EVALUATION, key=jr.key(1))
    for numbers in drawn:
        limits = paths.LIMITS[name].items()
        assert all(low <= numbers[number] <= high for number, (low, high) in limits)
    assert len({tuple(numbers.values()) for numbers in drawn}) == paths.EVALUATION


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="a scenario is one of"):
        paths.draw("dancing", 1, key=jr.key(0))
    with pytest.raises(ValueError, match="one gripper"):
        paths.lift_path(hanging(SIZE, 0.5), DURATION)
    with pytest.raises(ValueError, match="two grippers"):
        paths.fling_path(on_table(SIZE, ("origin",)), DURATION)


POSITIVE, NOT_NEGATIVE, SHARE = (0.0, -1.0, math.nan), (-1e-9, math.inf), (0.0, 1.1, math.nan)
WRONG = {
    "lifting": {"height m": NOT_NEGATIVE, "inward m": NOT_NEGATIVE, "moving s": POSITIVE},
    "wind": {"gap -": SHARE, "speed m/s": NOT_NEGATIVE, "height m": POSITIVE},
    "stretching": {"strain -": NOT_NEGATIVE, "moving s": POSITIVE, "height m": NOT_NEGATIVE},
    "folding": {"reach -": SHARE, "height -": NOT_NEGATIVE, "moving s": POSITIVE},
    "fling": {"gap -": SHARE, "forward m": NOT_NEGATIVE, "there s": POSITIVE, "wait s": (-1.0,)},
    "shaking": {"amplitude m": NOT_NEGATIVE, "frequency 1/s": POSITIVE, "fade s": POSITIVE},
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_numbers_that_make_no_sense_are_refused(name):
    """With the number, its unit, and the value."""
    for quantity, values in WRONG[name].items():
        number, unit = quantity.split()
        for value in values:
            with pytest.raises(ValueError) as error:
                SCENARIOS[name](**{number: value})
            text = str(error.value)
            assert text.startswith(f"{number} must") and f"[{unit}], found {value}" in text


@pytest.mark.parametrize(
    ("name", "numbers", "words"),
    [
        ("lifting", {"moving": 4.0}, "moving is 4 s, but the path ends after 3.93333 s"),
        ("folding", {"num_frames": 20}, "moving is 2.5 s, but the path ends after 1.26667 s"),
        ("fling", {"wait": 3.0}, r"wait \+ there \+ back is 4.1 s"),
        ("shaking", {"fade": 2.0}, r"2 fade \+ still is 4.5 s"),
        ("shaking", {"frequency": 13.0}, "frequency must be at most 12 1/s, found 13.0"),
        ("wind", {"aside": 120.0}, r"aside must be from -90 to 90 \[degrees\], found 120.0"),
        ("lifting", {"num_frames": 1}, "num_frames must be at least 2, found 1"),
        ("lifting", {"interval": 0.0}, r"interval must be positive \[s\], found 0.0"),
    ],
)
def test_a_path_that_would_not_come_to_rest_is_refused(name, numbers, words):
    with pytest.raises(ValueError, match=words):
        SCENARIOS[name](**numbers)


def test_numbers_beside_a_route_are_refused():
    with pytest.raises(ValueError, match="wind: a route is given, which gap would not change"):
        wind(route=wind().route, gap=0.9)
