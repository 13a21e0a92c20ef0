"""Of a stretching the force is one more coordinate of a frame's point on PhysNet's map."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.physnet import estimator, training
from r2s.estimation.physnet.estimator import Sighting
from r2s.estimation.physnet.method import PhysNetMethod, PublishedPhysNet
from r2s.estimation.physnet.network import Architecture
from r2s.estimation.physnet.pull_force import SCALE, PullForce, pull_force
from r2s.estimation.physnet.views import eye_of, floor_of, view_around
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
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
def sighting(recording):
    """With an untrained network and empty images: only the force tells."""
    experiment, seen = recording
    scenario = experiment.scenario(SHAPE)
    points = np.asarray(scenario.scene.mesh.rest)
    points = np.column_stack([points, np.zeros(len(points))])
    view = view_around(eye_of(experiment), points, 16, floor_of(experiment))
    untrained = training.begin(view, Architecture(16, (4,), (8,)))
    images, pull = np.zeros((len(FRAMES), 16, 16)), pull_force(seen, FRAMES)
    return Sighting.make(scenario, images, FRAMES, SPACE, untrained, pull=pull)


def test_the_true_force_is_where_it_was_recorded_and_twice_the_stiffness_apart(sighting):
    true = SPACE.to_unit(KNIT)
    warp, weft = (SPACE.ranges[i] for i in (0, 1))
    slippery = true.at[-1].set(0.0)  # so that the yarns take the pull alone, not the table
    twice = slippery.at[0].add(np.log(2) / warp.width).at[1].add(np.log(2) / weft.width)
    answers = np.asarray(estimator.answers(sighting, jnp.stack([true, slippery, twice])))
    width = sighting.points.shape[1]
    parts = [each.reshape(len(FRAMES), width) / np.sqrt(width) for each in answers]
    along = -3  # the pull is along x, the first of the three directions that end a point
    recorded = np.asarray(sighting.points[:, along])
    assert parts[0][-1, along] == pytest.approx(recorded[-1], abs=SCALE * 0.03)  # the cell's noise
    further = parts[2][-1, along] - parts[1][-1, along]
    assert further == pytest.approx(SCALE * np.log(2), rel=0.05)


def test_a_force_that_is_small_counts_by_its_difference():
    pull = PullForce(jnp.array([[1.0]]), jnp.eye(3)[:1], jnp.array(0.05))
    small = dataclasses.replace(pull, values=jnp.array([[1e-4]]))
    assert float(small.recorded[0, 0]) == pytest.approx(SCALE * 1e-4 / 0.05, rel=1e-3)


def test_only_a_stretching_has_one_and_the_published_method_reads_none(recording):
    _, seen = recording
    lift = synthetic.record(
        lifting(num_frames=4, interval=1.0), KNIT, "lift", shape=SHAPE, key=jax.random.key(0)
    )
    assert pull_force(lift, (0, 1)) is None
    assert pull_force(dataclasses.replace(seen, force=None), FRAMES) is None
    assert PhysNetMethod().reads(seen).force and not PublishedPhysNet().reads(seen).force
    still = dataclasses.replace(seen, force=jnp.zeros_like(seen.force))
    with pytest.raises(ValueError, match="zero throughout"):
        pull_force(still, FRAMES)
