"""Shards that a seed makes again, and an estimate from images of a known fabric."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.physnet import dataset, estimator, images, training
from r2s.estimation.physnet.dataset import Settings
from r2s.estimation.physnet.estimator import ImageObservation
from r2s.estimation.physnet.training import Architecture

TINY = Settings(
    num_fabrics=3, num_levels=2, num_frames=2, size=16, shape=(3, 3), per_shard=2, seed=5
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    dataset.make(folder, TINY, progress=False)
    return folder


@pytest.fixture(scope="module")
def observation(folder):
    """The first motion of the first fabric, without flaws."""
    view, data = dataset.load_manifest(folder).view, dataset.load(folder)
    experiment = dataset.levels(TINY)[0]
    frames = dataset.frame_indices(experiment.frames_used, TINY.num_frames)
    seen = images.of_depths(view, data.depth[0] * dataset.DEPTH_UNIT)
    untrained = training.begin(view, Architecture(16, (4,), (8,)))
    scenario = experiment.scenario(TINY.shape)
    return ImageObservation.make(scenario, seen, frames, TINY.space, untrained)


def distances(observation, places):
    """The rms distances on the map."""
    off = np.asarray(estimator.answers(observation, jnp.asarray(places))) - observation.target
    return np.sqrt((off**2).mean(axis=1))


@pytest.mark.slow(group="physnet")
def test_holds_what_the_settings_say(folder):
    data, manifest = dataset.load(folder), dataset.load_manifest(folder)
    assert data.depth.shape == (6, 2, 16, 16) and data.places.shape == (3, 7)
    np.testing.assert_array_equal(data.fabric, [0, 0, 1, 1, 2, 2])
    seen = data.depth[data.depth > 0] * dataset.DEPTH_UNIT
    assert 0.9 * manifest.view.near < seen.min() and seen.max() < 1.1 * manifest.view.far
    assert not np.array_equal(data.depth[0], data.depth[2])  # fabrics differ
    assert not np.array_equal(data.depth[0], data.depth[1])  # motions differ


@pytest.mark.slow(group="physnet")
def test_goes_on_where_it_stopped_with_the_same_bytes(folder):
    before, path = dataset.load_manifest(folder), folder / "0001.npz"
    kept, data = (folder / "0000.npz").stat().st_mtime_ns, path.read_bytes()
    path.write_bytes(b"torn")
    with pytest.raises(ValueError, match=r"0001\.npz is missing or damaged"):
        dataset.load(folder)
    path.unlink()
    assert dataset.make(folder, TINY, progress=False) == before
    assert (folder / "0000.npz").stat().st_mtime_ns == kept and path.read_bytes() == data


def test_other_settings_in_the_same_folder_are_refused(folder):
    with pytest.raises(ValueError, match="other settings: seed 5 there, 6 asked"):
        dataset.make(folder, dataclasses.replace(TINY, seed=6))
    with pytest.raises(ValueError, match="scenario must be one of .*'lifting'.*found 'lift'"):
        dataclasses.replace(TINY, scenario="lift")


def test_ranges_are_those_of_the_family_unless_given():
    assert [bound.name for bound in Settings(solver="mpm").ranges] == ["E h", "nu"]
    assert len(Settings().ranges) == 7
    with pytest.raises(ValueError, match="the space has the ranges .'E h', 'nu'., found"):
        dataclasses.replace(Settings(), solver="mpm")  # with those of the other space
    one = (dataclasses.replace(Settings(solver="mpm").ranges[0], high=20.0),)
    narrow = Settings(solver="mpm", ranges=(*one, Settings(solver="mpm").ranges[1]))
    assert float(narrow.space.values(jnp.ones(2))[0]) == pytest.approx(20)


@pytest.mark.slow(group="physnet")
def test_the_distance_is_least_at_the_fabric_that_was_seen(observation, folder):
    truth = jnp.asarray(dataset.load(folder).places[0])
    rough, soft = truth.at[6].set(1 - truth[6]), truth.at[2].set(1 - truth[2])
    places = jnp.stack([truth, rough, soft, jnp.full_like(truth, jnp.nan)])
    found = distances(observation, places)
    assert 10 * float(found[0]) < min(float(found[1]), float(found[2]))  # the files round depths
    assert np.isnan(found[3])


@pytest.mark.slow(group="physnet")
def test_an_estimate_goes_on_and_is_the_last_of_what_was_tried(observation, tmp_path):
    pytest.importorskip("sklearn")
    path = tmp_path / "trials.npz"
    first = estimator.estimate(observation, num_calls=12, path=path)
    assert first.loss == first.losses[-1] and first.losses.shape == (12, 1)
    again = estimator.estimate(observation, num_calls=12, path=path)
    np.testing.assert_array_equal(first.history, again.history)
    place = TINY.space.to_unit(first.fabric)
    np.testing.assert_allclose(distances(observation, place[None])[0], first.loss, rtol=1e-3)
    assert np.isnan(first.narrowing).all()


@pytest.mark.slow(group="physnet")
def test_the_published_recipe_gives_the_best_of_what_was_tried(observation, tmp_path):
    pytest.importorskip("skopt")

    def run():
        path = tmp_path / "history.npz"
        return estimator.estimate(observation, published=True, num_calls=6, path=path)

    first = run()
    assert first.loss == first.losses.min() and first.losses.shape == (6, 1)
    np.testing.assert_array_equal(first.history, run().history)


def test_images_and_frames_must_belong_together(observation):
    empty, scenario = np.zeros((2, 16, 16)), observation.scenario
    untrained = training.begin(observation.view, Architecture(16, (4,), (8,)))
    for frames in ((59,), (30, 60)):
        with pytest.raises(ValueError, match="of 60 simulated: expected one image for each frame"):
            ImageObservation.make(scenario, empty, frames, TINY.space, untrained)


@pytest.mark.slow(group="physnet")
def test_material_points_make_data_too(tmp_path):
    settings = dataclasses.replace(TINY, num_fabrics=2, solver="mpm", ranges=(), shape=(5, 5))
    dataset.make(tmp_path, settings, progress=False)
    data = dataset.load(tmp_path)
    assert data.depth.shape == (4, 2, 16, 16) and (data.depth > 0).any(axis=(2, 3)).all()
    assert data.places.shape == (2, 2)
