"""Frames at the camera's own times: the motion is that of even frames, wherever they lie."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation.prediction import predict, theta_length
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import rollout

SHAPE = (4, 4)
FABRIC = presets.black_denim()
EVEN = scenarios.lifting(num_frames=10, interval=1 / 10, height=0.2, inward=0.1, moving=0.6)
run = eqx.filter_jit(rollout)


@pytest.fixture(scope="module")
def even():
    return run(EVEN.scenario(SHAPE), FABRIC)


@pytest.mark.parametrize("kept", [[0, 1, 3, 4, 6, 7, 9], [3, 4, 5, 6, 7, 8, 9], [4, 9]])
def test_dropped_frames_and_cameras_that_begin_late_change_nothing_else(even, kept):
    """The gripper begins to move at the first frame."""
    scenario = EVEN._replace(times=EVEN.times[kept]).scenario(SHAPE)
    assert scenario.frame_times is None or len(scenario.places) == len(kept)
    motion = run(scenario, FABRIC)
    np.testing.assert_allclose(motion.times, EVEN.times[kept], atol=1e-6)
    np.testing.assert_allclose(motion.x, even.x[np.array(kept)], atol=1e-5)


def test_frames_off_their_times_lie_on_the_motion_between(even):
    """To first order by the velocity, and to the error of steps that are not quite as long."""
    late = np.array([0, 4, -3, 2, 4, -4, 1, -2, 3, 0]) * 1e-3
    motion = run(EVEN._replace(times=EVEN.times + late).scenario(SHAPE), FABRIC)
    moved = even.x + even.v * late[:, None, None]
    assert np.abs(motion.x - moved).max() < 0.4 * np.abs(moved - even.x).max()


def test_a_motion_that_ends_before_a_frame_is_no_motion_of_it():
    scenario = EVEN._replace(times=EVEN.times[[0, 1, 3, 9]]).scenario(SHAPE)
    soft = dataclasses.replace(FABRIC, density=jnp.asarray(jnp.nan))
    motion = run(scenario, soft)
    assert len(motion.ok) == 4 and not bool(motion.ok[-1]) and int(motion.result)


@pytest.mark.parametrize("name", ["lifting", "stretching"])
def test_a_prediction_of_uneven_frames_is_that_of_the_even_ones(name):
    """Clouds and markers, with the force, and where the clock is in doubt."""
    motion = {"num_frames": 9, "interval": 1 / 10, "moving": 0.5}
    whole = synthetic.record(
        scenarios.SCENARIOS[name](**motion), FABRIC, "denim", shape=SHAPE, key=jr.key(0)
    )
    kept = np.array([0, 1, 3, 4, 6, 8])
    first, last = 0, len(kept) - 1
    markers = {} if whole.markers is None else {"markers": whole.markers[kept]}
    if whole.markers_seen is not None:
        markers["markers_seen"] = whole.markers_seen[kept]
    info = dataclasses.replace(whole.info, frames_used=(first, last))
    some = dataclasses.replace(
        whole,
        points=whole.points[kept],
        mask=whole.mask[kept],
        times=whole.times[kept],
        info=info,
        **markers,
    )
    space = OrthotropicSpace.make(float(FABRIC.density))
    doubt = NuisancePrior(time=0.05)
    problems = [Problem.make(r, space, shape=SHAPE, nuisance_prior=doubt) for r in (whole, some)]
    theta = jnp.full(theta_length((problems[0],)), 0.4, float)
    theta = theta.at[space.dim : -1].set(0).at[-1].set(0.3)  # a clock that is 15 ms late
    predictions = [eqx.filter_jit(predict)(problem, theta) for problem in problems]
    used = np.searchsorted(problems[0].frames, kept[np.isin(kept, problems[0].frames)])
    of_some = np.flatnonzero(np.isin(kept, problems[0].frames))
    np.testing.assert_allclose(predictions[1].x[of_some], predictions[0].x[used], atol=1e-5)
    if predictions[0].force is not None and predictions[1].force is not None:
        np.testing.assert_allclose(
            predictions[1].force[of_some], predictions[0].force[used], rtol=1e-4, atol=1e-4
        )


def test_uneven_frames_have_a_gradient_and_a_batch_axis():
    scenario = EVEN._replace(times=EVEN.times[[0, 1, 3, 9]] + [0, 0.003, 0.001, 0]).scenario(SHAPE)

    def height(density):
        fabric = dataclasses.replace(FABRIC, density=density)
        return rollout(scenario, fabric).x[-1, :, 2].mean()

    densities = jnp.array([0.28, 0.32, 0.36])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(height)))(densities)
    expected = (values[2] - values[0]) / (densities[2] - densities[0])
    np.testing.assert_allclose(slopes[1], expected, rtol=0.05)


def test_the_last_rest_is_before_the_first_motion_of_a_gripper():
    """A path that is logged from long before: the sheet lies until it moves."""
    times, path = EVEN.route
    early = np.concatenate([[times[0] - 7.0], times])
    route = EVEN.route._replace(times=early, path=np.concatenate([path[:1], path]))
    logged = EVEN._replace(route=route).scenario(SHAPE)
    assert logged.num_frames == 10 and logged.frame_times is None
    np.testing.assert_allclose(
        run(logged, FABRIC).x, run(EVEN.scenario(SHAPE), FABRIC).x, atol=1e-5
    )
