"""Shards that a seed reproduces, and an estimate from images of a known fabric."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.physnet import dataset, images, method, training
from r2s.estimation.physnet.dataset import Settings
from r2s.estimation.physnet.method import ImageObservation
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
    depths = jnp.asarray(data.depth[0] * dataset.DEPTH_UNIT, float)
    shown = np.asarray(jax.vmap(partial(images.grey, view))(depths))
    untrained = training.begin(view, Architecture(16, (4,), (8,)))
    scenario = experiment.scenario(TINY.shape)
    return ImageObservation.make(scenario, shown, frames, TINY.space, untrained)


def distances(observation, places):
    """The rms distances on the map."""
    off = np.asarray(method.answers(observation, jnp.asarray(places))) - observation.target
    return np.sqrt((off**2).mean(axis=1))


@pytest.mark.slow(group="physnet")
def test_data_are_those_of_the_settings(folder):
    data, manifest = dataset.load(folder), dataset.load_manifest(folder)
    assert data.depth.shape == (6, 2, 16, 16) and data.places.shape == (3, 7)
    np.testing.assert_array_equal(data.fabric, [0, 0, 1, 1, 2, 2])
    depths = data.depth[data.depth > 0] * dataset.DEPTH_UNIT
    assert 0.9 * manifest.view.near < depths.min() and depths.max() < 1.1 * manifest.view.far
    assert not np.array_equal(data.depth[0], data.depth[2])  # fabrics differ
    assert not np.array_equal(data.depth[0], data.depth[1])  # motions differ


@pytest.mark.slow(group="physnet")
def test_an_interrupted_set_continues_with_the_same_bytes(folder):
    before, path = dataset.load_manifest(folder), folder / "0001.npz"
    kept, data = (folder / "0000.npz").stat().st_mtime_ns, path.read_bytes()
    path.write_bytes(b"torn")
    with pytest.raises(ValueError, match=r"0001\.npz is missing or damaged"):
        dataset.load(folder)
    path.unlink()
    assert dataset.make(folder, TINY, progress=False) == before
    assert (folder / "0000.npz").stat().st_mtime_ns == kept and path.read_bytes() == data


def test_other_settings_in_the_same_folder_are_refused(folder):
    with pytest.raises(ValueError, match="data of other settings"):
        dataset.make(folder, dataclasses.replace(TINY, seed=6))


def test_ranges_are_those_of_the_family_unless_given():
    usual = Settings(solver="mpm").space.ranges
    assert [bound.name for bound in usual] == ["E h", "nu"] and Settings().space.dim == 7
    narrow = Settings(solver="mpm", ranges=(dataclasses.replace(usual[0], high=20.0), usual[1]))
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
@pytest.mark.parametrize("published, calls", [(False, 12), (True, 6)])
def test_an_estimate_continues_from_its_file(observation, tmp_path, published, calls):
    """It is the last of the simulations; as published, the best."""
    pytest.importorskip("skopt" if published else "sklearn")
    options = {"published": published, "num_calls": calls, "path": tmp_path / "trials.npz"}
    first, again = (method.estimate(observation, **options) for _ in range(2))
    assert first.losses.shape == (calls, 1)
    assert first.loss == (first.losses.min() if published else first.losses[-1])
    np.testing.assert_array_equal(first.history, again.history)
    place = TINY.space.to_unit(first.fabric)
    np.testing.assert_allclose(distances(observation, place[None])[0], first.loss, rtol=1e-3)
    assert np.isnan(first.narrowing).all()


@pytest.mark.slow(group="physnet")
def test_material_points_make_data_too(tmp_path):
    settings = dataclasses.replace(TINY, num_fabrics=2, solver="mpm", ranges=(), shape=(5, 5))
    dataset.make(tmp_path, settings, progress=False)
    data = dataset.load(tmp_path)
    assert data.depth.shape == (4, 2, 16, 16) and (data.depth > 0).any(axis=(2, 3)).all()
    assert data.places.shape == (2, 2)
