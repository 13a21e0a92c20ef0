"""Losses: values by hand, masks, and derivatives against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import directional_difference, flat
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.mesh.mesh import borders
from r2s.metrics.losses import (
    OUTLIER_SCALE,
    one_sided_chamfer,
    robust,
    robust_curvature,
    robust_weight,
    surface_residuals,
)

EVERY = jnp.ones(40, bool)
chamfer = jax.jit(one_sided_chamfer)
residuals = jax.jit(surface_residuals)


@pytest.fixture
def clouds():
    random = np.random.default_rng(0)
    return tuple(jnp.asarray(random.uniform(size=(n, 3))) for n in (40, 30))


def test_one_sided_chamfer_by_hand():
    points = jnp.array([[0.0, 0, 0], [1, 0, 0], [5, 5, 5]])
    targets = jnp.array([[0.0, 0, 2], [1, 0.5, 0]])
    mask = jnp.array([True, True, False])
    # nearest to the first is (1, 0.5, 0) at a square of 1.25, to the second 0.25
    assert one_sided_chamfer(points, mask, targets) == pytest.approx(0.75)


def test_masked_points_change_neither_value_nor_gradient(clouds):
    points, targets = clouds
    mask = jnp.arange(40) < 25
    elsewhere = jnp.where(mask[:, None], points, 1e3)
    assert chamfer(points, mask, targets) == chamfer(elsewhere, mask, targets)
    assert chamfer(points, mask, targets) == chamfer(points[:25], mask[:25], targets)
    gradient = jax.grad(one_sided_chamfer)(points, mask, targets)
    assert jnp.all(gradient[25:] == 0) and jnp.all(gradient[:25] != 0)
    assert jnp.isnan(chamfer(points, ~EVERY, targets))


@pytest.fixture
def surface(sheet):
    """A crumpled sheet with points around it."""
    random = np.random.default_rng(1)
    x = flat(sheet) + jnp.asarray(random.normal(size=(25, 3))) * 0.01
    return jnp.asarray(random.uniform(-0.05, 0.25, (40, 3))), x


def test_residuals_are_distances_along_their_direction(surface, sheet):
    points, x = surface
    mask = jnp.arange(40) % 2 == 0
    assert jnp.all((residuals(points, mask, x, sheet.faces)[0] > 0) == mask)
    distance, direction, vertices, weights = residuals(points, EVERY, x, sheet.faces)
    place = np.einsum("pk,pki->pi", weights, np.asarray(x[vertices]))
    gap = np.asarray(distance)[:, None] * np.asarray(direction)
    assert np.linalg.norm(direction, axis=1) == pytest.approx(1, abs=1e-12)
    assert place + gap == pytest.approx(np.asarray(points), abs=1e-12)


def test_residuals_move_with_the_vertices_as_described(surface, sheet):
    points, x = surface
    _, direction, vertices, weights = residuals(points, EVERY, x, sheet.faces)
    motion = jax.random.normal(jax.random.key(0), x.shape)

    def distance(x):
        return residuals(points, EVERY, x, sheet.faces)[0]

    expected = directional_difference(distance, x, motion, 1e-7)
    described = -jnp.einsum("pi,pk,pki->p", direction, weights, motion[vertices])
    assert np.asarray(described) == pytest.approx(np.asarray(expected), abs=1e-5)


def test_with_slack_noise_does_not_pull_at_the_borders(sheet):
    """Noise about a flat sheet makes it seem too small, unless it may go on beyond its borders."""
    side = jnp.max(sheet.rest, axis=0)
    key, other = jax.random.split(jax.random.key(0))
    places = jnp.pad(jax.random.uniform(key, (4000, 2)) * side[None], ((0, 0), (0, 1)))
    points = places + 2e-3 * jax.random.normal(other, places.shape)
    mask = jnp.ones(len(points), bool)
    middle = jnp.pad(side / 2, (0, 1))[None]

    def loss(stretch, slack):
        x = (flat(sheet) - middle) * (1 + stretch) + middle
        found = surface_residuals(points, mask, x, sheet.faces, borders(sheet), slack)
        return jnp.mean(found[0] ** 2) / 2

    pull = jax.jit(jax.grad(loss))
    assert pull(0.0, 0.0) < -1e-6  # [m^2]: larger would be better
    assert abs(pull(0.0, 0.01)) < 1e-9
    # what lies farther away than the slack still pulls
    assert pull(-0.1, 0.002) < -1e-5


@given(st.floats(0, 1), st.sampled_from([0.0, 3e-3, 0.02]))
@settings(max_examples=25, deadline=None)
def test_the_robust_weight_is_its_slope_over_the_distance(distance, scale):
    distance = jnp.array(distance)
    slope = jax.grad(robust)(distance, scale)
    assert slope == pytest.approx(float(robust_weight(distance, scale) * distance), rel=1e-9)
    curvature = jax.grad(jax.grad(robust))(distance, scale)
    assert curvature == pytest.approx(float(robust_curvature(distance, scale)), rel=1e-9, abs=1e-12)


def test_with_a_scale_what_is_far_off_does_not_pull():
    near, far = jnp.array(1e-4), jnp.array(0.1)
    assert robust_weight(jnp.array(OUTLIER_SCALE)) == pytest.approx(0.5)
    assert robust(near, 5e-3) == pytest.approx(0.5e-8, rel=1e-3)
    assert robust(far, 5e-3) == pytest.approx(5e-3**2 / 2, rel=1e-2)

    def pull(scale):
        return float(robust_weight(far, scale) * far)

    assert pull(5e-3) < 1e-3 * pull(0.0)
