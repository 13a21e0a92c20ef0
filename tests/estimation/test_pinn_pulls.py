"""What the network reads of a recording, and what is said of bad ones."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.pinn.pulls import pull_from, stacked
from r2s.estimation.problem import Problem
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.recording import RecordingInfo, make_recording
from r2s.scenarios import stretching

FRAMES, SIDE, PULLED, FORCE = 9, 0.45, 0.018, 4.0  # [m], [m], [N]


def recording(info=None, **changes):
    """A sheet that stretches evenly: 9 markers, whose force grows with the stretch."""
    experiment = stretching((SIDE, SIDE), num_frames=FRAMES, moving=0.2, strain=PULLED / SIDE)
    times = np.asarray(experiment.times)
    usual = RecordingInfo(
        "test", "stretching", "none", "1", "test", (0, FRAMES - 1), experiment.sheet, 0.0, None
    )
    knots, path = np.asarray(experiment.route.times), np.asarray(experiment.route.path)
    far = np.interp(times, knots, path[:, 2, 0]) - SIDE
    along = (np.arange(3) + 0.5) / 3 * SIDE
    places = np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
    moved = places[None, :, 0] / SIDE * far[:, None]
    parts = {
        "markers": np.stack([places[:, 0] + moved, 0 * moved + places[:, 1], 0 * moved + 1e-3], -1),
        "force": np.stack([FORCE * far / PULLED, 0 * far, 0 * far], 1),
        "force_times": times,
    }
    info = dataclasses.replace(usual, **(info or {}))
    return make_recording(None, times, path, knots, info, **(parts | changes))


MARKERS, ALONG = np.asarray(recording().markers), np.asarray(recording().force)[:, 0]
SHEET = recording().info.sheet


def hidden(frames, which):
    markers = MARKERS.copy()
    markers[frames, which] = np.nan
    return markers


def test_displacements_clamps_and_force_are_those_of_the_recording():
    pull = pull_from(recording())
    np.testing.assert_allclose(pull.displacement[-1, :, 0], pull.places[:, 0] / SIDE * PULLED)
    np.testing.assert_allclose(pull.displacement[..., 1], 0, atol=1e-12)
    np.testing.assert_allclose(pull.near.value, 0, atol=1e-12)
    np.testing.assert_allclose(pull.far.value[-1], [PULLED, 0], atol=1e-9)
    assert pull.force is not None
    np.testing.assert_allclose(pull.force[-1], FORCE)
    np.testing.assert_allclose(pull.gravity, 0, atol=1e-12)  # the table carries the weight
    np.testing.assert_allclose(pull.normal, 9.81)
    of_numbers = pull_from(recording(force=ALONG))
    np.testing.assert_allclose(np.asarray(of_numbers.force), ALONG)


def test_clamps_have_the_rates_of_their_path():
    """Those of a smooth path: it begins and ends at rest, and covers its way."""
    pull = pull_from(recording())
    rates, step = np.asarray(pull.far.rate[:, 0]), float(pull.times[1])
    np.testing.assert_allclose(np.trapezoid(rates, dx=step), PULLED, rtol=0.01)
    assert abs(rates[0]) < 0.15 * rates.max() and abs(rates[-1]) < 0.15 * rates.max()


def test_a_marker_that_is_not_seen_for_a_while_is_left_out():
    pull = pull_from(recording(markers=hidden(3, 2)))
    assert not pull.seen[3, 2] and pull.seen.sum() == FRAMES * 9 - 1
    assert bool(jnp.isfinite(pull.displacement).all())


def test_markers_are_where_the_recording_says_that_they_were_put():
    """No square grid, and none of them in the middle of a cell."""
    markers = MARKERS[:, :8] + np.array([0.004, 0, 0])
    places = markers[0, :, :2]
    pull = pull_from(recording(markers=markers, marker_places=places))
    np.testing.assert_allclose(pull.places, places, atol=1e-9)
    assert np.abs(np.asarray(pull.displacement[0])).max() < 1e-9


BAD = {
    "2 frames: at least 3": {"info": {"frames_used": (0, 1)}},
    "frame 4: 2 of 9 markers": {"markers": hidden(4, slice(2, None))},
    "5. are seen in no frame": {"markers": hidden(slice(None), 5)},
    "no force: without it only ratios": {"force": None, "force_times": None},
    "is the force in newtons": {"force": 1e5 * ALONG},
    "positive along the pull": {"force": np.outer(-ALONG, [1, 0, 0])},
    "on the same clock": {"force_times": 100 + np.arange(FRAMES)},
    "not in metres": {"markers": 1e3 * MARKERS},
    "in another order": {"markers": MARKERS[:, ::-1]},
    "out of the plane": {"markers": MARKERS + np.array([0, 0, 0.05])},
    "no square grid": {"markers": MARKERS[:, :8]},
}


@pytest.mark.parametrize("says", BAD)
def test_bad_input_is_explained(says):
    with pytest.raises(ValueError, match=f"recording test: .*{says}"):
        pull_from(recording(**BAD[says]))


def test_a_recording_without_markers_or_four_clamped_corners_is_refused():
    whole = recording()
    held = dataclasses.replace(whole.info, sheet=dataclasses.replace(SHEET, pinned=("origin",)))
    changes = {
        "no markers": {"markers": None, "markers_seen": None},
        "four corners": {"info": held},
    }
    for says, change in changes.items():
        with pytest.raises(ValueError, match=says):
            pull_from(dataclasses.replace(whole, **change))


def test_frames_at_uneven_times_show_the_same_pull():
    """Of markers that move evenly, to the curvature of their path between two frames."""
    whole = recording()
    times = np.asarray(whole.times, np.float64)
    late = times + 0.2 * (times[1] - times[0]) * np.array([0, 1, -1, 1, 0, -1, 1, -1, 0])
    far = np.interp(late, whole.gripper_times, whole.gripper_path[:, 2, 0]) - SIDE
    even = np.interp(times, whole.gripper_times, whole.gripper_path[:, 2, 0]) - SIDE
    share = np.asarray(whole.markers)[0, :, 0] / SIDE
    moved = np.asarray(whole.markers).copy()
    moved[..., 0] += share[None] * (far - even)[:, None]
    shifted = dataclasses.replace(whole, times=jnp.asarray(late), markers=jnp.asarray(moved))
    one, other = pull_from(whole), pull_from(shifted)
    np.testing.assert_allclose(other.times, one.times, atol=1e-6)
    np.testing.assert_allclose(other.displacement, one.displacement, atol=0.03 * PULLED)


def test_pulls_with_and_without_force_or_of_other_lengths_do_not_go_together():
    one, other = pull_from(recording()), pull_from(recording(), without_force=True)
    assert other.force is None
    with pytest.raises(ValueError, match="have a force, or none"):
        stacked([one, other])
    with pytest.raises(ValueError, match="as many frames"):
        stacked([one, pull_from(recording(info={"frames_used": (0, 5)}))])


def test_methods_that_simulate_refuse_such_forces_too():
    space = OrthotropicSpace.make(0.2)
    force = Problem.make(recording(force=ALONG), space, shape=(3, 3)).force
    assert force is not None
    np.testing.assert_allclose(np.asarray(force.values)[:, 0], ALONG, rtol=1e-5)
    late = {"force": ALONG, "force_times": 100 + np.arange(FRAMES)}
    for bad, says in ((late, "on the same clock"), ({"force": -ALONG}, "positive along the pull")):
        with pytest.raises(ValueError, match=says):
            Problem.make(recording(**bad), space, shape=(3, 3))
