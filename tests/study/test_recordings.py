"""Recordings for evaluation and the start of their predictions; pulls."""

from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.pinn.pulls import pulled
from r2s.materials import presets
from r2s.metrics.losses import to_surface
from r2s.recordings.recording import cloud
from r2s.scenarios.paths import LIMITS
from r2s.scenarios.standard import SCENARIOS
from r2s.study import plan as plans
from r2s.study.evaluations import predict
from r2s.study.recordings import (
    SETTLING,
    SyntheticRecording,
    pull_of,
    read,
    read_start,
    small_strain,
    started,
)
from r2s.study.tasks import execute

FLING = SCENARIOS["fling"](num_frames=30)


def test_a_hanging_sheet_starts_in_the_shape_that_is_given_held_where_the_path_begins():
    truth, other = FLING.scenario((9, 9)), FLING.scenario((5, 5))
    shape = np.asarray(truth.start).reshape(9, 9, 3) + np.array([0.0, 0.02, 0.0])
    moved = started(other, shape)
    free = np.asarray(other.scene.is_free)
    expected = shape[::2, ::2].reshape(-1, 3)  # vertices that both meshes have
    np.testing.assert_allclose(np.asarray(moved.start)[free], expected[free], atol=1e-6)
    held = np.asarray(moved.scene.pinned)
    np.testing.assert_allclose(np.asarray(moved.start)[held], np.asarray(other.path)[1], atol=1e-6)
    assert bool(jnp.all(moved.path[0] == moved.path[1]))
    assert (moved.lead_in - 1) * moved.interval < SETTLING <= moved.lead_in * moved.interval + 1e-9
    assert bool(jnp.all(moved.path_times == other.path_times))


def test_a_sheet_on_the_table_starts_flat():
    lying = SCENARIOS["folding"]().scenario((5, 5))
    assert started(lying, None) is lying
    with pytest.raises(ValueError, match="lies on the table"):
        started(lying, np.zeros((5, 5, 3)))


@pytest.mark.slow(group="study")
def test_the_true_fabric_begins_where_its_recording_does(tmp_path, monkeypatch):
    """Flat sheets of two meshes come to rest in two shapes, a centimetre apart."""
    shape = (25, 25)
    monkeypatch.setattr("r2s.study.evaluations.SHAPES", {"cloth": shape})
    source = SyntheticRecording("camel_ponte_roma", "fling", 0, True)
    execute(source, tmp_path)
    recording, start = read(source, tmp_path), read_start(source, tmp_path)
    assert start is not None and start.shape == (*source.truth.shape, 3)
    faces = FLING.scenario(shape).scene.mesh.faces

    def away(starts):
        (moved,) = predict([recording], small_strain(source.fabric), "cloth", starts)
        clouds = [cloud(recording, frame) for frame in (0, 3)]
        return to_surface(clouds, np.asarray(moved.x)[[0, 3]], faces)

    assert np.all(away([start]) < 3e-3)
    assert np.all(away(()) > 5e-3)


def test_pulls_differ_in_stretch_and_rate_from_angle_to_angle_and_number_to_number():
    drawn = [pull_of(number, angle, 0) for number in range(4) for angle in plans.PULLS]
    for name, (low, high) in LIMITS["stretching"].items():
        values = [each[name] for each in drawn]
        assert len(set(values)) == len(values) and low <= min(values) and max(values) <= high
    assert drawn != [pull_of(number, angle, 1) for number in range(4) for angle in plans.PULLS]


@pytest.mark.slow(group="study")
def test_shorter_steps_of_a_pull_change_the_force_that_holds_it_and_the_markers_little():
    """On the way, in a pull faster than those of the study, the force of a soft knit by 8 %."""
    settings: dict[str, Any] = {"frames": 9, "moving": 0.25, "shape": (5, 5), "key": jr.key(0)}
    exact: dict[str, Any] = {"marker_noise": 0.0, "force_noise": 0.0}
    fine, finer = (
        pulled(presets.grey_interlock(), "grey", steps=steps, **settings, **exact)
        for steps in (3, 6)
    )
    assert fine.markers is not None and finer.markers is not None
    force, other = (np.asarray(each.force)[:, 0] for each in (fine, finer))
    assert abs(force[-1] - other[-1]) < 0.01 * force.max()
    assert np.abs(force - other).max() < 0.1 * force.max()
    assert np.asarray(fine.times) == pytest.approx(np.arange(9) / 30)
    assert np.abs(np.asarray(fine.markers - finer.markers)).max() < 1e-4
