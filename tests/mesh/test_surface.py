"""The surface of a sheet: nearest places against a search by hand, and samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import few, flat
from hypothesis import given
from hypothesis import strategies as st

from r2s.mesh.surface import nearest, sample

TRIANGLE = jnp.array([[0, 1, 2]])
coordinate = st.floats(-2, 2)
triangles = st.tuples(*[st.tuples(coordinate, coordinate, coordinate)] * 3).filter(
    lambda c: np.linalg.norm(np.cross(np.subtract(c[1], c[0]), np.subtract(c[2], c[0]))) > 1e-2
)
find = jax.jit(nearest)
GRID = 60
fine = jax.jit(lambda corners: sample(corners, TRIANGLE, GRID))


@pytest.fixture(scope="module")
def crumpled(sheet):
    """A crumpled sheet, and points around it."""
    random = np.random.default_rng(0)
    x = flat(sheet) + jnp.asarray(random.normal(size=(25, 3))) * 0.02
    return x, jnp.asarray(random.uniform(-0.1, 0.3, (200, 3)))


def places(points, x, faces):
    face, weights = find(points, x, faces)
    return np.einsum("pk,pki->pi", weights, np.asarray(x[faces[face]])), np.asarray(weights)


@given(triangles, st.tuples(coordinate, coordinate, coordinate))
@few
def test_nothing_on_a_triangle_is_nearer(corners, point):
    corners, point = np.array(corners), np.array(point)
    found, weights = places(jnp.asarray(point[None]), jnp.asarray(corners), TRIANGLE)
    distance = np.linalg.norm(found[0] - point)
    assert np.min(weights) >= -1e-12 and np.sum(weights) == pytest.approx(1, abs=1e-12)
    others = np.linalg.norm(np.asarray(fine(jnp.asarray(corners))) - point, axis=1)
    cell = np.max(np.linalg.norm(np.roll(corners, 1, axis=0) - corners, axis=1)) / GRID
    assert distance <= np.min(others) + 1e-9
    assert distance >= np.min(others) - cell


def test_nearest_places_equal_those_of_trimesh(sheet, crumpled):
    trimesh = pytest.importorskip("trimesh")
    x, points = crumpled
    found, _ = places(points, x, sheet.faces)
    solid = trimesh.Trimesh(np.asarray(x), np.asarray(sheet.faces), process=False)
    expected, *_ = trimesh.proximity.closest_point_naive(solid, np.asarray(points))
    assert found == pytest.approx(expected, abs=1e-10)


def test_a_place_on_the_sheet_is_its_own_nearest(sheet, crumpled):
    x, _ = crumpled
    points = sample(x, sheet.faces, 2)
    assert places(points, x, sheet.faces)[0] == pytest.approx(np.asarray(points), abs=1e-12)


@pytest.mark.parametrize("resolution", range(1, 8))
def test_samples_lie_one_in_each_small_triangle(resolution):
    weights = np.asarray(sample(jnp.eye(3), TRIANGLE, resolution))  # barycentric
    assert weights.shape == (resolution**2, 3) and np.all(weights > 0)
    assert weights.sum(axis=1) == pytest.approx(1, abs=1e-14)
    assert weights.mean(axis=0) == pytest.approx(1 / 3, abs=1e-14)  # the centroid
    small = {tuple(cell) for cell in np.floor(resolution * weights).tolist()}
    assert len(small) == resolution**2
    # and in the middle of it: a third or two thirds from each of its sides
    place = (resolution * weights) % 1
    assert np.minimum(np.abs(place - 1 / 3), np.abs(place - 2 / 3)) == pytest.approx(0, abs=1e-12)
