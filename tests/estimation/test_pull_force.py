"""Of a stretching the force is one more coordinate of a frame's point on PhysNet's map."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.physnet import method, training
from r2s.estimation.physnet.images import view_of
from r2s.estimation.physnet.method import (
    FLAW,
    NOISE,
    SCALE,
    ImageObservation,
    PhysNetMethod,
    PublishedPhysNet,
    PullForce,
    pull_force,
)
from r2s.estimation.physnet.training import Architecture
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import lifting, stretching, synthetic

SHAPE, FRAMES = (3, 3), (2, 11)
KNIT = presets.grey_interlock()
SPACE = OrthotropicSpace.make(float(KNIT.density))


@pytest.fixture(scope="module")
def recording():
    experiment = stretching(num_frames=12, moving=0.3)
    return experiment, synthetic.record(
        experiment, KNIT, "pull", shape=SHAPE, key=jax.random.key(0)
    )


@pytest.fixture(scope="module")
def observation(recording):
    """With an untrained network and empty images: only the force counts."""
    experiment, pulled = recording
    scenario = experiment.scenario(SHAPE)
    points = np.asarray(scenario.scene.mesh.rest)
    points = np.column_stack([points, np.zeros(len(points))])
    view = view_of(experiment, points, 16)
    untrained = training.begin(view, Architecture(16, (4,), (8,)))
    images, pull = np.zeros((len(FRAMES), 16, 16)), pull_force(pulled, FRAMES)
    return ImageObservation.make(scenario, images, FRAMES, SPACE, untrained, pull=pull)


@pytest.mark.slow(group="estimates")
def test_the_true_force_is_where_it_was_recorded_and_twice_the_stiffness_apart(observation):
    true = SPACE.to_unit(KNIT)
    warp, weft = (SPACE.ranges[i] for i in (0, 1))
    slippery = true.at[-1].set(0.0)  # so that the yarns take the pull alone, not the table
    twice = slippery.at[0].add(np.log(2) / warp.width).at[1].add(np.log(2) / weft.width)
    answers = np.asarray(method.answers(observation, jnp.stack([true, slippery, twice])))
    width = observation.points.shape[1]
    parts = [each.reshape(len(FRAMES), width) / np.sqrt(width) for each in answers]
    recorded = np.asarray(observation.points[:, -1])  # the last coordinate of a point
    assert parts[0][-1, -1] == pytest.approx(recorded[-1], abs=3 * FLAW)  # the cell's noise
    of_slippery, of_twice = (np.sinh(part[-1, -1] / SCALE) for part in parts[1:])
    assert of_twice == pytest.approx(2 * of_slippery, rel=0.05)


def coordinate(force: float) -> float:
    pull = PullForce(jnp.array([force]), jnp.eye(3)[0], jnp.array(0.05))
    return float(pull.recorded[0, 0])


def test_a_force_counts_by_its_ratio_and_a_small_one_by_its_difference():
    assert coordinate(10.0) - coordinate(5.0) == pytest.approx(SCALE * np.log(2), rel=1e-3)
    assert coordinate(1e-4) == pytest.approx(SCALE * 1e-4 / 0.05, rel=1e-3)


def test_noise_of_a_load_cell_counts_like_a_flawed_image_at_most(recording):
    """Of a fabric that is so soft that a pull needs little more than that noise, too."""
    _, seen = recording
    largest = float(jnp.max(jnp.abs(seen.force[:, 0])))
    soft = dataclasses.replace(seen, force=seen.force * (0.05 / largest))
    noisy = dataclasses.replace(soft, force=soft.force.at[:, 0].add(NOISE))
    recorded = [pull.recorded for each in (noisy, soft) if (pull := pull_force(each, FRAMES))]
    away = recorded[0] - recorded[1]
    assert 0.7 * FLAW < float(jnp.max(jnp.abs(away))) <= 1.01 * FLAW


@pytest.mark.slow(group="estimates")
def test_only_a_stretching_has_one_and_the_published_method_reads_none(recording):
    _, pulled = recording
    lift = synthetic.record(
        lifting(num_frames=4, interval=1.0), KNIT, "lift", shape=SHAPE, key=jax.random.key(0)
    )
    assert pull_force(lift, (0, 1)) is None
    assert pull_force(dataclasses.replace(pulled, force=None), FRAMES) is None
    assert PhysNetMethod().reads(pulled).force and not PublishedPhysNet().reads(pulled).force
    still = dataclasses.replace(pulled, force=jnp.zeros_like(pulled.force))
    with pytest.raises(ValueError, match="zero throughout"):
        pull_force(still, FRAMES)


@pytest.mark.slow(group="estimates")
def test_a_state_file_of_another_observation_is_refused(observation, tmp_path):
    """Its answers would be those of another density, and its target another recording's."""
    options = {"num_calls": SPACE.dim + 2, "path": tmp_path / "search.npz"}
    whole, again = (method.estimate(observation, **options) for _ in range(2))
    assert np.array_equal(whole.losses, again.losses)
    assert "0x" not in repr(jax.tree.structure(observation))  # the same in another process
    heavier = dataclasses.replace(observation, space=OrthotropicSpace.make(0.3))
    further = dataclasses.replace(observation, points=observation.points + 1.0)
    for other in (heavier, further):
        with pytest.raises(ValueError, match="another run"):
            method.estimate(other, **options)
