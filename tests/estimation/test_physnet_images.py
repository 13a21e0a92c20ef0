"""Depth images of points: of simulated surfaces and of recorded clouds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rgbd_scene import calibrated
from scipy import ndimage

from r2s import scenarios
from r2s.estimation.physnet import images
from r2s.estimation.physnet.images import View, depths_of_sheet, view_around
from r2s.mesh.mesh import rectangle
from r2s.recordings.cameras import Camera, DepthCamera
from r2s.recordings.views import render
from r2s.scenarios import synthetic

VIEW = View((0.1, -0.4, 0.6), (0.1, 0.1, 0.1), 40.0, 32, 0.4, 1.0, -1.0)
MESH = rectangle((0.3, 0.3), (4, 4))
seen_by = jax.jit(images.depth_of, static_argnums=0)
shown = jax.jit(images.grey, static_argnums=0)
CLEAN = images.Flaws(noise=0.0, holes=0.0, strays=0.0, lost=0.0, gained=0.0, flying=0.0)
TILTED = np.c_[np.asarray(MESH.rest), 0.1 + 0.4 * np.asarray(MESH.rest[:, 1])]


def camera_of(view: View) -> DepthCamera:
    """The view as a calibrated camera."""
    place = [jnp.asarray(p, float) for p in (view.position, view.target)]
    return calibrated(Camera(place[0], place[1], view.focal_length, (view.size, view.size)))


def drawn(view: View = VIEW):
    depth = depths_of_sheet(view, jnp.asarray(TILTED)[None], MESH.faces, 24)
    return np.asarray(depth[0])


def test_agrees_with_exact_rendering():
    exact, _ = render(camera_of(VIEW), TILTED, np.asarray(MESH.faces))
    both = (drawn() > 0) & (exact > 0)
    assert both.sum() > 250
    assert np.abs(drawn() - exact)[both].mean() < 1e-3  # [m], on a surface tilted by 20 degrees
    # a pixel has depth where any of it sees the sheet, not only its middle
    assert ((exact > 0) & (drawn() == 0)).sum() == 0


def test_nearer_layers_hide_others_and_the_floor_is_left_out():
    low = jnp.array([[0.104, 0.1, 0.104]])  # in the middle of a pixel
    towards = jnp.asarray(VIEW.position) - low[0]
    high = low + 0.3 * towards[None]
    both = jnp.concatenate([low, high])
    depth = seen_by(VIEW, both, jnp.array([True, True]))
    forward = jnp.asarray(VIEW.target) - jnp.asarray(VIEW.position)
    distance = -float(towards @ forward / jnp.sqrt(forward @ forward))
    np.testing.assert_allclose(depth.max(), 0.7 * distance, rtol=1e-6)
    masked = seen_by(VIEW, both, jnp.array([True, False]))
    np.testing.assert_allclose(masked.max(), distance, rtol=1e-6)
    raised = dataclasses.replace(VIEW, floor=0.15)
    assert float(seen_by(raised, both, jnp.array([True, False])).max()) == 0


def test_a_view_around_points_holds_them_all():
    points = np.random.default_rng(0).uniform([0, 0, 0], [0.4, 0.3, 0.2], (200, 3))
    view = view_around((-0.5, -0.1, 0.5), points, 64, 0.01)
    seen = points[:, 2] > 0.01
    depth = seen_by(view, jnp.asarray(points), jnp.ones(200, bool))
    found = np.asarray(depth)[np.asarray(depth) > 0]
    assert view.near < found.min() and found.max() < view.far
    alone = jax.jit(jax.vmap(lambda p: seen_by(view, p[None], jnp.array([True])).max()))
    assert float(alone(jnp.asarray(points[seen])).min()) > 0
    with pytest.raises(ValueError, match="no point is higher than 1 m"):
        view_around((-0.5, -0.1, 0.5), points, 64, 1.0)


def test_measured_points_cover_as_much_as_the_surface_does():
    generator = np.random.default_rng(0)
    there = jnp.ones(900, bool)
    places = np.c_[generator.uniform(0, 0.3, (900, 2)), np.zeros(900)]
    places[:, 2] = 0.1 + 0.4 * places[:, 1]

    def covered(depth):
        return float((shown(VIEW, depth) > 0).sum())

    whole = covered(jnp.asarray(drawn()))
    points = jnp.asarray(places)
    assert covered(seen_by(VIEW, points, there)) < 0.97 * whole
    measured = jax.jit(images.depth_of_cloud, static_argnums=0)(VIEW, points, there)
    assert 0.97 < covered(measured) / whole < 1.03


def test_holes_are_filled_and_strays_dropped():
    whole = drawn()
    image = shown(VIEW, jnp.asarray(whole))
    inside = np.argwhere(whole > 0)
    inner = [(i, j) for i, j in inside if (whole[i - 2 : i + 3, j - 2 : j + 3] > 0).all()]
    broken = whole.copy()
    for i, j in inner[::7]:
        broken[i, j] = 0
    broken[1, 1] = 0.5
    mended = shown(VIEW, jnp.asarray(broken))
    assert float(image[1, 1]) == float(mended[1, 1]) == 0
    np.testing.assert_array_equal(image > 0, mended > 0)
    assert float(jnp.max(jnp.abs(image - mended))) < 0.02


def test_flaws_are_those_asked_for():
    depth = jnp.full((32, 32), 0.8)
    flaws = dataclasses.replace(CLEAN, noise=1e-3)
    noisy = images.flawed(depth, VIEW, flaws, jax.random.key(0))
    np.testing.assert_allclose(np.std(noisy), 0.64e-3, rtol=0.1)
    flaws = dataclasses.replace(CLEAN, holes=0.4)
    shares = [
        float((images.flawed(depth, VIEW, flaws, jax.random.key(i)) == 0).mean()) for i in range(20)
    ]
    assert max(shares) < 0.5 and min(shares) < 0.1 < np.mean(shares) < 0.3


def test_borders_lose_gain_and_err_and_nothing_else_does():
    whole = drawn()
    there = whole > 0
    inner = np.asarray(ndimage.binary_erosion(there, np.ones((3, 3))), bool)
    outer = np.asarray(ndimage.binary_dilation(there, np.ones((3, 3))), bool)
    flaw = jax.jit(jax.vmap(images.flawed, in_axes=(None, None, None, 0)), static_argnums=(1, 2))
    keys = jax.random.split(jax.random.key(0), 50)
    flaws = dataclasses.replace(CLEAN, lost=0.5, gained=0.2, flying=1e-2)
    broken = np.asarray(flaw(jnp.asarray(whole), VIEW, flaws, keys))
    np.testing.assert_array_equal(
        broken[:, inner], np.broadcast_to(whole[inner], (50, inner.sum()))
    )
    assert (broken[:, ~outer] == 0).all()
    lost = (broken[:, there & ~inner] == 0).mean(axis=1)  # from 0 to `lost`, by image
    assert lost.min() < 0.1 and 0.4 < lost.max() < 0.65 and 0.2 < lost.mean() < 0.3
    gained = (broken[:, outer & ~there] > 0).mean(axis=1)
    assert gained.max() < 0.35 and 0.06 < gained.mean() < 0.14
    edge = broken[:, there & ~inner]
    error = np.abs(edge - whole[there & ~inner])[edge > 0]
    assert 2e-3 < error.mean() < 8e-3  # of Laplace's, the mean is the scale: 0 to 1e-2


def test_clouds_become_depth():
    experiment = scenarios.lifting()
    view = images.view_of(experiment, np.array([[0, 0, 0.01], [0.45, 0.45, 0.4]]), 32)
    cloud = np.random.default_rng(0).uniform([0.1, 0.1, 0.1], [0.3, 0.3, 0.3], (2000, 3))
    info = synthetic.RecordingInfo(
        "cup", "lifting", "f", "1", "s", (0, 1), experiment.sheet, 0.0, None
    )
    path = np.zeros((2, 1, 3))
    recording = synthetic.make_recording([cloud, cloud[:1999]], [0, 1], path, [0, 1], info)
    first, second = images.of_clouds(view, recording, (0, 1))
    assert first.shape == (32, 32) and np.abs(first - second).max() < 0.3
    empty = dataclasses.replace(recording, points=recording.points * 1000)
    eye = jnp.asarray(view.position)[None, None]
    close = dataclasses.replace(recording, points=eye + 0.01 * (recording.points - eye))
    for broken, message in ((empty, "0 pixels have a depth"), (close, "the median depth is .* m")):
        with pytest.raises(ValueError, match=f"cup, frame 0: {message}"):
            images.of_clouds(view, broken, (0, 1))


def test_a_stray_point_that_was_spread_is_dropped():
    inside = np.asarray(MESH.rest)[:, :2].max(axis=0)
    plane = np.random.default_rng(0).uniform([0, 0], inside, (1500, 2))
    points = np.c_[plane, 0.1 + 0.4 * plane[:, 1]]
    far = np.array([[-0.1, 0.1, 0.1], [-0.12, 0.2, 0.15]])  # beside the sheet
    see = jax.jit(lambda points: images.depth_of_cloud(VIEW, points, jnp.ones(len(points), bool)))
    clean, stray = (np.asarray(see(jnp.asarray(p))) for p in (points, np.r_[points, far]))
    plain = np.asarray(images.depth_of(VIEW, jnp.asarray(far), jnp.ones(2, bool), jnp.asarray(0.5)))
    assert (plain > 0).sum() >= 4  # more than a pixel for each
    alone = (plain > 0) & (clean == 0)
    assert alone.any() and (stray[alone] == 0).all()
    assert ((clean > 0) == (stray > 0))[plain == 0].mean() > 0.99
