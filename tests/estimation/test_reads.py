"""Methods read of a recording what they declare (`Method.reads`), and nothing else."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation.method import default_space
from r2s.estimation.methods import METHODS, last_frame
from r2s.estimation.pinn.pulls import pull_from, pulled
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import POINTS, Problem
from r2s.materials import presets
from r2s.scenarios import synthetic

FABRIC = presets.grey_interlock()
SPACE = default_space("cloth", float(FABRIC.density))


@pytest.fixture(scope="module")
def lift():
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 1.0}
    experiment = scenarios.lifting(num_frames=24, interval=1 / 15, **motion)
    return synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))


@pytest.fixture(scope="module")
def pull():
    return pulled(FABRIC, "grey", shape=(5, 5), frames=6, moving=0.1, steps=3, key=jr.key(0))


def poisoned(recording, frames):
    """With other points in these frames, as many as before."""
    points = np.asarray(recording.points).copy()
    points[list(frames)] += 0.02
    return dataclasses.replace(recording, points=jnp.asarray(points))


def matching_shape(one, other) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def others(recording, frames):
    return sorted(set(range(len(recording.times))) - set(frames))


@pytest.mark.parametrize("name", ["diffcloud", "diffcp", "cma-es"])
def test_descents_read_some_points_of_the_frames_that_count(lift, name):
    reads = METHODS[name]().reads(lift)
    assert (reads.points, reads.markers, reads.force) == (POINTS, False, False)
    problem = Problem.make(lift, SPACE, shape=(4, 4))
    assert matching_shape(
        problem, Problem.make(poisoned(lift, others(lift, reads.frames)), SPACE, shape=(4, 4))
    )
    assert problem.clouds is not None and problem.clouds.points.shape[1] == reads.points
    for frame in (reads.frames[0], reads.frames[-1]):
        changed = Problem.make(poisoned(lift, [frame]), SPACE, shape=(4, 4))
        assert not matching_shape(problem, changed)


def test_descents_read_markers_instead_of_clouds_and_the_force_where_it_was_measured(pull):
    reads = METHODS["diffcloud"]().reads(pull)
    assert (reads.points, reads.markers, reads.force) == (0, True, True)
    problem = Problem.make(pull, SPACE, shape=(5, 5))
    assert matching_shape(problem, Problem.make(poisoned(pull, reads.frames), SPACE, shape=(5, 5)))
    without = dataclasses.replace(pull, force=None, force_times=None)
    assert not METHODS["diffcloud"]().reads(without).force
    assert Problem.make(without, SPACE, shape=(5, 5)).force is None


def test_the_network_reads_markers_and_force_and_no_clouds(pull):
    reads = METHODS["pinn"]().reads(pull)
    assert (reads.points, reads.markers, reads.force) == (0, True, True)
    assert matching_shape(pull_from(pull), pull_from(poisoned(pull, reads.frames)))
    without = dataclasses.replace(pull, force=None, force_times=None)
    with pytest.raises(ValueError, match="no force"):
        pull_from(without)
    with pytest.raises(ValueError, match="no markers"):
        pull_from(dataclasses.replace(pull, markers=None, markers_seen=None))
    published = METHODS["pinn-published"]().reads(pull)
    assert published.markers and not published.force
    given = [pull_from(each, without_force=True) for each in (pull, without)]
    assert matching_shape(*given)


def test_images_are_made_of_some_frames(lift):
    from r2s.estimation.physnet import images
    from r2s.estimation.physnet.images import view_around

    reads = METHODS["physnet"]().reads(lift)
    assert reads.points is None and len(reads.frames) == 8
    x = np.asarray(lift.points)[np.asarray(lift.mask)]
    view = view_around((0.2, -0.6, 0.6), x, 32, 0.0)
    seen = images.of_clouds(view, lift, reads.frames)
    hidden = poisoned(lift, others(lift, reads.frames))
    assert np.array_equal(seen, images.of_clouds(view, hidden, reads.frames))
    changed = images.of_clouds(view, poisoned(lift, reads.frames[-1:]), reads.frames)
    assert not np.array_equal(seen, changed)


def test_the_published_recipe_reads_the_last_frame_alone(lift):
    reads = METHODS["diffcloud-published"](shape=(4, 4)).reads(lift)
    assert reads.frames == (lift.info.frames_used[1],)
    problem = Problem.make(lift, SPACE, shape=(4, 4))
    x = jnp.zeros((len(problem.frames), 16, 3))

    def loss(recording):
        seen = Prediction(x, None, jnp.asarray(True))
        return float(last_frame(Problem.make(recording, SPACE, shape=(4, 4)), seen))

    assert loss(lift) == loss(poisoned(lift, others(lift, reads.frames)))
    assert loss(lift) != loss(poisoned(lift, reads.frames))
