"""Swings: read from a tool's pose and tracked points, simulated, and estimated from."""

import dataclasses
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from folders import ROOT
from scipy.spatial.transform import Rotation

from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.datasets import Swings, known_bar, known_datasets
from r2s.recordings.open import open_recording
from r2s.recordings.recording import gripper_positions, load, save
from r2s.recordings.swings import Bar, bar_path, read_swing
from r2s.scenarios.scenario import from_recording, rollout
from r2s.scenarios.standard import swing

DATA = Path(os.environ.get("R2S_SWINGS") or ROOT.parent / "shared" / "data" / "swings_real")
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the swings are not at {DATA}; set R2S_SWINGS to their folder"
)
SIZE = (0.28, 0.3)
BAR = Bar(
    ends=((-0.14, 0.0, 0.1), (0.14, 0.0, 0.1)),
    drop=0.3,
    lag=0.3,
    lag_deviation=0.02,
    place_deviation=0.01,
    tracker_error=(0.001,) * 5,
    note="made up",
)
FABRIC = dataclasses.replace(presets.grey_interlock(), density=jnp.asarray(0.12))


@pytest.fixture(scope="module")
def moved():
    """The arrays of a swing of 2 s, every fifth of whose fine frames a tracker saw."""
    experiment = swing(SIZE, num_frames=81, interval=0.025, sway=0.15, turn=20.0)
    scenario = experiment.scenario((5, 5))
    x = np.asarray(rollout(scenario, FABRIC).x)
    route = experiment.route
    middle = route.path.mean(axis=1)
    along = route.path[:, 1] - route.path[:, 0]
    angle = np.arctan2(along[:, 1], along[:, 0])
    turn = Rotation.from_rotvec(angle[:, None] * [[0, 0, 1]])
    return {
        "times": experiment.times[::5] + BAR.lag,
        "points": x[::5].reshape(-1, 5, 5, 3),
        "tool_times": route.times,
        "tool_position": middle - [0, 0, 0.1],
        "tool_quaternion_xyzw": turn.as_quat(),
    }


@pytest.fixture
def file(moved, tmp_path: Path) -> Path:
    np.savez(tmp_path / "swing.npz", **moved)
    return tmp_path / "swing.npz"


def test_the_bar_of_a_swing_is_straight_and_follows_its_ends():
    experiment = swing(SIZE, num_frames=21)
    scenario = experiment.scenario((5, 4))
    path, ends = np.asarray(scenario.path)[2:], experiment.route.path
    held = np.asarray(scenario.scene.pinned)
    order = np.argsort(held)
    np.testing.assert_array_equal(held[order], np.arange(5) * 4)  # one side of the warp
    share = np.linspace(0, 1, 5)[None, :, None]
    expected = (1 - share) * ends[:, :1] + share * ends[:, 1:]
    np.testing.assert_allclose(path[:, order], expected, atol=1e-6)
    np.testing.assert_allclose(ends[0], ends[-1], atol=1e-3)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) == pytest.approx(SIZE[0])


def test_a_swing_is_read_on_the_arm_s_clock_with_its_sheet_below_the_bar(file: Path, moved):
    read = read_swing(file, BAR)
    assert read.info.scenario == "swing" and read.info.sheet.size == pytest.approx(SIZE)
    np.testing.assert_allclose(np.diff(read.times), 0.1, rtol=1e-4)
    frames = len(read.times)
    np.testing.assert_allclose(read.times, np.arange(frames) * 0.1, atol=1e-6)
    ends = bar_path(moved["tool_position"], moved["tool_quaternion_xyzw"], BAR)
    np.testing.assert_allclose(read.gripper_path, ends, atol=1e-6)
    assert read.markers is not None
    for frame, tracked in ((0, 0), (5, 4), (10, 8)):  # every 0.1 s and every 0.125 s
        expected = moved["points"][tracked].reshape(-1, 3)
        np.testing.assert_allclose(np.asarray(read.markers[frame]), expected, atol=1e-4)
    assert np.asarray(read.markers_seen).all()


@pytest.mark.slow(group="motions")
def test_the_fabric_that_swung_is_where_its_markers_are_and_a_light_one_is_not(file: Path):
    read = read_swing(file, BAR)
    scenario = from_recording(read, (5, 5))
    of = jax.jit(lambda fabric: rollout(scenario, fabric).x)

    def error(fabric) -> float:
        away = np.linalg.norm(np.asarray(of(fabric)) - np.asarray(read.markers), axis=-1)
        return float(away.mean())

    light = dataclasses.replace(FABRIC, density=jnp.asarray(0.02))
    assert error(FABRIC) < 4e-3  # frames between those that were tracked are interpolated
    assert error(light) > 3 * error(FABRIC)


@pytest.mark.slow(group="motions")
def test_a_swing_is_kept_with_the_places_of_its_markers(file: Path, tmp_path: Path):
    read = read_swing(file, BAR)
    save(read, tmp_path / "kept.npz")
    again = load(tmp_path / "kept.npz")
    assert again.info == read.info
    np.testing.assert_array_equal(again.marker_places, read.marker_places)
    problem = Problem.make(again, OrthotropicSpace.make(0.12), shape=(5, 5))
    assert problem.markers is not None and read.markers is not None
    corners = read.markers[0][np.asarray(problem.markers.vertices)]
    places = jnp.einsum("mk,mki->mi", problem.markers.weights, corners)
    np.testing.assert_allclose(places, read.markers[0], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("points", lambda a: a[..., 0], "along the bar, down, 3"),
        ("tool_quaternion_xyzw", lambda a: 2 * a, "length 1"),
        ("tool_position", lambda a: a + np.nan, "tool_position: .* not finite"),
        ("tool_times", lambda a: a[::-1], "must increase"),
        ("tool_position", lambda a: a[1:], "tool_position must have the shape"),
        ("times", lambda a: a + 100, "frames every"),
        ("tool_quaternion_xyzw", lambda a: a * 0 + [0, 0.5**0.5, 0, 0.5**0.5], "about level"),
    ],
)
def test_what_is_wrong_with_a_swing_is_named(tmp_path: Path, moved, name, change, words):
    np.savez(tmp_path / "bad.npz", **(moved | {name: change(moved[name])}))
    with pytest.raises(ValueError, match=f"bad.npz: .*{words}"):
        read_swing(tmp_path / "bad.npz", BAR)


def test_where_the_tracker_lost_the_sheet_the_recording_ends_with_a_warning(tmp_path: Path, moved):
    points = moved["points"].copy()
    points[8:14] = np.nan
    np.savez(tmp_path / "lost.npz", **(moved | {"points": points}))
    with pytest.warns(UserWarning, match="lost the sheet from 0.88 to 1.75 s"):
        read = read_swing(tmp_path / "lost.npz", BAR)
    assert float(read.times[-1]) < 0.9


@pytest.mark.slow(group="estimates")
def test_a_swing_tells_the_density(file: Path):
    """A light sheet is held back by the air; density counts against the air's, which is known."""
    prior = NuisancePrior(0.0, 0.0, density=1.0)
    space = OrthotropicSpace.make(0.2)
    problem = Problem.make(read_swing(file, BAR), space, shape=(5, 5), nuisance_prior=prior)
    found = descend(problem, Budget(12, 2, 15, num_probes=0), key=jr.key(0))
    (density,) = found.nuisances
    assert 0.2 * density.value == pytest.approx(0.12, rel=0.15)


def test_the_public_swings_have_a_manifest_with_their_bar():
    data = known_datasets()["swings"]
    assert isinstance(data, Swings) and data.bar == known_bar()
    assert data.bar.length == pytest.approx(0.284, abs=1e-3)


@needs_data
def test_every_public_swing_is_read_and_its_bar_is_where_the_tool_says():
    """To within 45 mm, which is the tracker's error while it moves fast."""
    for file in sorted(DATA.glob("*.npz"))[::5]:
        read = open_recording(file)
        ends = gripper_positions(read)[:, :, None]
        share = np.linspace(0, 1, 8)[None, :, None]
        bar = (1 - share) * ends[:, 0] + share * ends[:, 1]
        top = np.asarray(read.markers).reshape(-1, 8, 8, 3)[:, :, 0]
        seen = np.asarray(read.markers_seen).reshape(-1, 8, 8)[:, :, 0]
        error = np.linalg.norm(top - bar, axis=-1)[seen].mean()
        assert 0.01 < error < 0.045, file.stem
