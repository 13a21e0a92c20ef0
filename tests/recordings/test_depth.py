"""Cameras, and depth images of meshes: exact against geometry, with flaws of a given size."""

from dataclasses import replace
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rgbd_scene import FACES, LENS, calibrated, camera, surface

from r2s.recordings.cameras import (
    Camera,
    back_project,
    depth_jumps,
    from_world,
    look_at,
    matrix,
    moved,
    rays,
)
from r2s.recordings.images import read_depth, write_depth
from r2s.recordings.synthetic_rgbd import NONE, TYPICAL, Flaws, flawed_depth, flawed_mask
from r2s.recordings.views import render

SMALL = (32, 24)
LENSES = [(), LENS]


def project(view, points):
    """Pixels (across, down), lens included, of points in the camera's axes [m], by OpenCV."""
    still, lens = np.zeros(3), np.array(view.distortion or (0.0,) * 4)
    found = cv2.projectPoints(points, still, still, matrix(view), lens)[0]
    return found.reshape(-1, 2)


def seen(lens: tuple[float, ...] = (), **changes: Any):
    return camera((-0.3, -0.2, 0.5), distortion=lens, **changes)


@pytest.mark.parametrize("lens", LENSES)
def test_a_pixel_and_its_ray_belong_together(lens) -> None:
    view = seen(lens)
    directions = rays(view)
    points = np.concatenate([directions, np.ones((*directions.shape[:2], 1))], axis=2)
    pixels = project(view, 0.7 * points.reshape(-1, 3)).reshape(120, 160, 2)
    expected = np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=-1)
    np.testing.assert_allclose(pixels, expected, atol=0.01)


@pytest.mark.parametrize("lens", LENSES)
def test_the_points_of_a_rendered_plane_lie_in_the_plane(lens) -> None:
    corners = np.array([[-5.0, -5, 0.7], [5, -5, 0.7], [5, 5, -0.3], [-5, 5, -0.3]])
    view = seen(lens)
    depth, which = render(view, corners, np.array([[0, 1, 2], [0, 2, 3]]))
    assert (which >= 0).all()
    points = moved(np.array(view.to_world), back_project(view, depth, depth > 0))
    np.testing.assert_allclose(points[:, 2], 0.2 - 0.1 * points[:, 1], atol=1e-12)


def test_a_calibrated_camera_agrees_with_the_simulated_one() -> None:
    pinhole = Camera(jnp.array([-0.5, -0.1, 0.5]), jnp.array([0.25, 0.25, 0.1]))
    points = np.random.default_rng(0).uniform(-0.2, 0.6, (20, 3))
    pixel, depth = pinhole.project(jnp.asarray(points))
    view = calibrated(pinhole)
    np.testing.assert_allclose(from_world(view, points)[:, 2], depth)
    np.testing.assert_allclose(project(view, from_world(view, points)) + 0.5, pixel, atol=1e-6)


def test_looking_straight_down_is_refused() -> None:
    with pytest.raises(ValueError, match="no way up"):
        look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


@given(
    x=arrays(float, (9, 3), elements=st.floats(-0.25, 0.5, width=16)),
    lens=st.sampled_from(LENSES),
)
@settings(max_examples=60)
def test_each_pixel_sees_the_nearest_face(x: np.ndarray, lens: tuple[float, ...]) -> None:
    faces = np.arange(9).reshape(3, 3)
    view = seen(lens, resolution=SMALL)
    depth, which = render(view, x, faces)
    nearest = np.full(depth.shape, np.inf)
    directions = np.concatenate([rays(view), np.ones((*depth.shape, 1))], axis=2)
    for a, b, c in from_world(view, x)[faces]:
        system = np.stack([a, b, c], axis=1)
        if abs(np.linalg.det(system)) < 1e-9:  # seen edge on
            continue
        weights = np.linalg.solve(system, directions.reshape(-1, 3).T).T.reshape(directions.shape)
        inside = (weights >= 0).all(axis=2)
        nearest[inside] = np.minimum(nearest, 1 / weights.sum(axis=2))[inside]
    sure = np.isfinite(nearest) & (depth > 0)
    np.testing.assert_allclose(depth[sure], nearest[sure], rtol=1e-6)
    # rays through an edge may count as in or out, and thin faces may be seen edge on
    assert (sure == (depth > 0)).mean() > 0.98
    assert ((depth > 0) == (which >= 0)).all()


def test_jumps_of_depth_are_found_on_both_sides_but_not_at_holes() -> None:
    depth = np.array([[1.0, 1.0, 1.5, 1.5], [1.0, 1.0, 0.0, 1.5]])
    expected = [[False, True, True, False], [False, False, False, False]]
    np.testing.assert_array_equal(depth_jumps(depth, 0.1), expected)
    assert not depth_jumps(depth, 1.0).any()


def test_depth_survives_its_file_but_for_rounding(tmp_path) -> None:
    depth = np.random.default_rng(0).uniform(0.3, 3, (24, 32))
    for scale in (1e-3, 1e-4):
        write_depth(tmp_path / "a.png", depth, scale)
        read = read_depth(tmp_path / "a.png", scale, SMALL)
        np.testing.assert_allclose(read, depth, atol=0.505 * scale)
    with pytest.raises(ValueError, match="does not fit into 16 bits"):
        write_depth(tmp_path / "far.png", 100 * depth, 1e-3)


@pytest.fixture(scope="module")
def flawed():
    """The depth of a wave as a camera sees it, and a function that makes flaws in it."""
    view, x = camera((-0.4, -0.1, 0.45)), surface(0)
    depth, which = render(view, x, FACES)

    def make(flaws: Flaws, seed: int = 0) -> np.ndarray:
        return flawed_depth(view, depth, which, x, FACES, flaws, np.random.default_rng(seed))

    return depth, make


def test_no_flaws_change_nothing_and_a_seed_repeats(flawed) -> None:
    depth, make = flawed
    np.testing.assert_array_equal(make(NONE), depth)
    np.testing.assert_array_equal(make(TYPICAL, 1), make(TYPICAL, 1))
    assert (make(TYPICAL, 1) != make(TYPICAL, 2)).any()


def test_each_flaw_is_as_large_as_it_says(flawed) -> None:
    depth, make = flawed
    seen = depth > 0
    error = (make(replace(NONE, noise=2e-3)) - depth)[seen] / depth[seen] ** 2
    assert error.std() == pytest.approx(2e-3, rel=0.05)
    holes = make(replace(NONE, holes=0.1))[seen] == 0
    assert holes.mean() == pytest.approx(0.1, abs=0.02)
    turned_away = make(replace(NONE, grazing=60.0))[seen] == 0
    assert 0.02 < turned_away.mean() < 0.9


def test_depth_at_edges_lies_between_the_two_sides(flawed) -> None:
    depth, make = flawed
    mixed = make(replace(NONE, edge_mixed=1.0))
    changed = mixed != depth
    assert changed.any() and not changed[~depth_jumps(depth, 0.02)].any()
    assert mixed[depth > 0].min() >= depth[depth > 0].min() and mixed.max() <= depth.max()


def test_the_border_of_a_mask_wanders_by_its_error() -> None:
    mask = np.zeros((120, 160), bool)
    mask[30:90, 40:120] = True
    wrong = flawed_mask(mask, 2.0, np.random.default_rng(0)) != mask
    assert wrong.any() and not wrong[38:82, 48:112].any()  # four deviations from the border
    np.testing.assert_array_equal(flawed_mask(mask, 0.0, np.random.default_rng(0)), mask)
