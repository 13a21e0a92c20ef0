"""Distances between recordings and motions: zero for the truth, larger for another fabric."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.materials import presets
from r2s.metrics import prediction_error
from r2s.recordings.recording import cloud
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import from_recording
from r2s.scenarios.standard import SCENARIOS
from r2s.solvers.results import Result
from r2s.solvers.simulate import Solution


def motion(recording, fabric):
    return prediction_error.predict_motion(from_recording(recording), fabric).x


@pytest.fixture(scope="module")
def lift():
    return synthetic.record(scenarios.lifting(), presets.grey_interlock(), "grey", key=jr.key(1))


@pytest.fixture(scope="module")
def predicted(lift):
    """The motion of the lift with its true fabric."""
    return motion(lift, presets.grey_interlock())


@pytest.mark.slow(group="motions")
def test_the_true_fabric_is_nearer_than_another_and_than_noise_allows(lift, predicted):
    truth = prediction_error.against_motion(lift, predicted)
    other = prediction_error.against_motion(lift, motion(lift, presets.pink_solid()))
    # 1 mm of noise, sampling of the surface every 5 mm, one point in a hundred 0.2 m away
    assert truth["chamfer_real_to_sim"] < 0.007
    assert truth["chamfer_real_to_sim"] < other["chamfer_real_to_sim"]
    assert truth["hausdorff"] >= truth["chamfer"]
    # below the lowest point of the recording is a sheet that no camera shows
    assert truth["chamfer_sim_to_real_cropped"] < truth["chamfer_sim_to_real"]


@pytest.mark.slow(group="study")
def test_a_whole_surface_tells_the_true_fabric_by_every_metric():
    experiment, fabric = SCENARIOS["fling"](), presets.grey_interlock()
    seen = synthetic.record(experiment, fabric, "grey", seen=synthetic.WHOLE, key=jr.key(0))
    clouds = [cloud(seen, frame) for frame in (0, 30)]
    assert all(len(points) == len(clouds[0]) > 5000 for points in clouds)
    truth, other = (
        prediction_error.against_motion(seen, motion(seen, each), 6, False)
        for each in (fabric, presets.pink_solid())
    )
    for name, value in truth.items():
        assert value < other[name] / 1.5, name
    assert truth["hausdorff"] < 0.01  # samples of the surface, 8 mm apart


def test_a_diverged_motion_is_a_result(lift):
    shape = (len(lift.times), 81, 3)
    found = prediction_error.against_motion(lift, np.full(shape, np.nan))
    whole = prediction_error.against_recording(lift, lift)
    assert found.keys() == whole.keys()
    assert all(np.isnan(value) for value in found.values())


def test_a_run_that_fails_is_lost_from_there_on_and_says_why(monkeypatch):
    failed = Solution(
        x=jnp.zeros((3, 9, 3)),
        v=jnp.zeros((3, 9, 3)),
        times=jnp.arange(3) / 15,
        final_state=None,
        ok=jnp.array([True, False, True]),
        result=jnp.array(Result.NON_FINITE.value),
        failed_at=jnp.array(0.05),
    )
    monkeypatch.setattr(prediction_error, "_rollout", lambda *_, **__: failed)
    scenario = SCENARIOS["fling"]().scenario((3, 3))
    moved = prediction_error.predict_motion(scenario, presets.grey_interlock())
    assert np.isfinite(moved.x).all(axis=(1, 2)).tolist() == [True, False, False]
    assert "failed at 0.05 s" in moved.failure


def test_every_metric_has_a_unit_and_words():
    one, other = np.eye(3), 1.1 * np.eye(3) + 0.01
    values = prediction_error.distances(one, other)
    values |= prediction_error.paper_units(one, other, one, other)
    assert values.keys() | {"surface"} == prediction_error.METRICS.keys()
