"""What the network is given of a recording, and what it says of bad ones."""

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


def recording(**changes):
    """A sheet that stretches evenly: 9 markers, whose force grows with the stretch."""
    experiment = stretching((SIDE, SIDE), num_frames=FRAMES, moving=0.2, strain=PULLED / SIDE)
    times = np.asarray(experiment.times)
    info = RecordingInfo(
        "test", "stretching", "none", "1", "test", (0, FRAMES - 1), experiment.sheet, 0.0, None
    )
    knots, path = np.asarray(experiment.route.times), np.asarray(experiment.route.path)
    far = np.interp(times, knots, path[:, 2, 0]) - SIDE
    along = (np.arange(3) + 0.5) / 3 * SIDE
    places = np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
    moved = places[None, :, 0] / SIDE * far[:, None]
    markers = np.stack([places[:, 0] + moved, 0 * moved + places[:, 1], 0 * moved + 1e-3], -1)
    parts = {
        "markers": markers,
        "force": np.stack([FORCE * far / PULLED, 0 * far, 0 * far], 1),
        "force_times": times,
    } | {name: value for name, value in changes.items() if name != "info"}
    info = dataclasses.replace(info, **changes.get("info", {}))
    return make_recording(None, times, path, knots, info, **parts)


def test_displacements_clamps_and_force_are_those_of_the_recording():
    pull = pull_from(recording())
    np.testing.assert_allclose(pull.displacement[-1, :, 0], pull.places[:, 0] / SIDE * PULLED)
    np.testing.assert_allclose(pull.displacement[..., 1], 0, atol=1e-12)
    np.testing.assert_allclose(pull.near.value, 0, atol=1e-12)
    np.testing.assert_allclose(pull.far.value[-1], [PULLED, 0], atol=1e-9)
    assert pull.force is not None
    np.testing.assert_allclose(pull.force[-1], FORCE)


def test_the_table_carries_the_weight():
    pull = pull_from(recording())
    np.testing.assert_allclose(pull.gravity, 0, atol=1e-12)
    np.testing.assert_allclose(pull.normal, 9.81)


def test_clamps_have_the_rates_of_their_path():
    """Those of a smooth path: it begins and ends at rest, and covers its way."""
    pull = pull_from(recording())
    rates, step = np.asarray(pull.far.rate[:, 0]), float(pull.times[1])
    np.testing.assert_allclose(np.trapezoid(rates, dx=step), PULLED, rtol=0.01)
    assert abs(rates[0]) < 0.15 * rates.max() and abs(rates[-1]) < 0.15 * rates.max()


def test_a_force_of_one_number_is_along_the_pull():
    whole = recording()
    number = np.asarray(whole.force)[:, 0]
    found = pull_from(dataclasses.replace(whole, force=jnp.asarray(number)))
    np.testing.assert_allclose(np.asarray(found.force), number)


def test_a_marker_that_is_not_seen_for_a_while_is_left_out():
    markers = np.asarray(recording().markers).copy()
    markers[3, 2] = np.nan
    pull = pull_from(recording(markers=markers))
    assert not pull.seen[3, 2] and pull.seen.sum() == FRAMES * 9 - 1
    assert bool(jnp.isfinite(pull.displacement).all())


def changed_markers(change):
    markers = np.asarray(recording().markers).copy()
    return recording(markers=change(markers))


def lost(frames, which):
    def change(markers):
        markers[frames, which] = np.nan
        return markers

    return change


BAD = {
    "2 frames: at least 3": lambda: recording(info={"frames_used": (0, 1)}),
    "no markers": lambda: dataclasses.replace(recording(), markers=None, markers_seen=None),
    "frame 4: 2 of 9 markers": lambda: changed_markers(lost(4, slice(2, None))),
    "marker 5 is seen in no frame": lambda: changed_markers(lost(slice(None), 5)),
    "no force: without it only ratios": lambda: dataclasses.replace(
        recording(), force=None, force_times=None
    ),
    "is the force in newtons": lambda: recording(force=1e5 * np.asarray(recording().force)),
    "force in newtons, and": lambda: recording(force=1e-3 * np.asarray(recording().force)),
    "positive along the pull": lambda: recording(force=-np.asarray(recording().force)),
    "on the same clock": lambda: recording(force_times=100 + np.arange(FRAMES)),
    "not in metres": lambda: changed_markers(lambda markers: 1e3 * markers),
    "in another order": lambda: changed_markers(lambda markers: markers[:, ::-1]),
    "out of the sheet's plane": lambda: changed_markers(lambda m: m + np.array([0, 0, 0.05])),
    "no square grid": lambda: changed_markers(lambda markers: markers[:, :8]),
    "evenly spaced": lambda: dataclasses.replace(
        recording(), times=recording().times.at[4].add(0.01)
    ),
    "clamped at four corners": lambda: dataclasses.replace(
        recording(),
        info=dataclasses.replace(
            recording().info, sheet=dataclasses.replace(recording().info.sheet, pinned=("origin",))
        ),
    ),
}


@pytest.mark.parametrize("says", BAD)
def test_bad_input_is_explained(says):
    with pytest.raises(ValueError, match=f"recording test: .*{says}"):
        pull_from(BAD[says]())


def test_without_force_only_when_asked():
    bare = dataclasses.replace(recording(), force=None, force_times=None)
    assert pull_from(bare, without_force=True).force is None


def test_pulls_that_do_not_go_together():
    one = pull_from(recording())
    with pytest.raises(ValueError, match="some recordings have a force"):
        stacked([one, pull_from(recording(), without_force=True)])
    short = pull_from(recording(info={"frames_used": (0, 5)}))
    with pytest.raises(ValueError, match="as many frames"):
        stacked([one, short])
    with pytest.raises(ValueError, match="one stretching"):
        stacked([])


def test_markers_are_where_the_recording_says_that_they_were_put():
    """No square grid, and none of them in the middle of a cell."""
    markers = np.asarray(recording().markers)[:, :8] + np.array([0.004, 0, 0])
    places = markers[0, :, :2]
    found = pull_from(recording(markers=markers, marker_places=places))
    np.testing.assert_allclose(found.places, places, atol=1e-9)
    assert np.abs(np.asarray(found.displacement[0])).max() < 1e-9


@pytest.mark.parametrize("says", ["on the same clock", "positive along the pull"])
def test_methods_that_simulate_refuse_such_forces_too(says):
    number = np.asarray(recording().force)[:, 0]
    good, bad = (
        {"force": number},
        {
            "on the same clock": {"force": number, "force_times": 100 + np.arange(FRAMES)},
            "positive along the pull": {"force": -number},
        }[says],
    )
    space = OrthotropicSpace.make(0.2)
    force = Problem.make(recording(**good), space, shape=(3, 3)).force
    assert force is not None
    np.testing.assert_allclose(np.asarray(force.values)[:, 0], number, rtol=1e-5)
    with pytest.raises(ValueError, match=says):
        Problem.make(recording(**bad), space, shape=(3, 3))
