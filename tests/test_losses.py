"""Losses: values by hand, masks, and derivatives against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import directional_difference, flat, rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.evaluation.losses import (
    OUTLIER_SCALE,
    from_surface,
    huber,
    one_sided_chamfer,
    robust,
    robust_curvature,
    robust_weight,
    sinkhorn,
    squared,
    surface_residuals,
    to_surface,
    trimmed_mean,
)
from r2s.geometry.mesh import borders

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


def test_a_cloud_is_at_no_distance_from_itself(clouds):
    points, targets = clouds
    assert chamfer(points, EVERY, points) == 0
    assert chamfer(points, EVERY, jnp.concatenate([targets, points])) == 0


def test_chamfer_does_not_change_with_rigid_motion(clouds):
    points, targets = clouds
    move = lambda cloud: cloud @ rotation(0.8, 1).T + jnp.array([[1.0, -2.0, 0.5]])
    expected = float(chamfer(points, EVERY, targets))
    assert chamfer(move(points), EVERY, move(targets)) == pytest.approx(expected, rel=1e-10)


def test_masked_points_change_neither_value_nor_gradient(clouds):
    points, targets = clouds
    mask = jnp.arange(40) < 25
    elsewhere = jnp.where(mask[:, None], points, 1e3)
    assert chamfer(points, mask, targets) == chamfer(elsewhere, mask, targets)
    assert chamfer(points, mask, targets) == chamfer(points[:25], mask[:25], targets)
    gradient = jax.grad(one_sided_chamfer)(points, mask, targets)
    assert jnp.all(gradient[25:] == 0) and jnp.all(gradient[:25] != 0)


def test_an_empty_mask_is_nan(clouds):
    assert jnp.isnan(chamfer(clouds[0], ~EVERY, clouds[1]))


def test_the_gradient_of_chamfer_agrees_with_differences(clouds):
    loss = lambda both: chamfer(both[0], EVERY, both[1])
    direction = tuple(jax.random.normal(jax.random.key(i), c.shape) for i, c in enumerate(clouds))
    expected = directional_difference(loss, clouds, direction, 1e-6)
    gradient = jax.grad(loss)(clouds)
    found = sum(jnp.sum(g * d) for g, d in zip(gradient, direction, strict=True))
    assert found == pytest.approx(float(expected), rel=1e-7)


@pytest.fixture
def surface(sheet):
    """A crumpled sheet with points around it."""
    random = np.random.default_rng(1)
    x = flat(sheet) + jnp.asarray(random.normal(size=(25, 3))) * 0.01
    return jnp.asarray(random.uniform(-0.05, 0.25, (40, 3))), x


def test_residuals_are_distances_along_their_direction(surface, sheet):
    points, x = surface
    distance, direction, vertices, weights = residuals(points, EVERY, x, sheet.faces)
    place = np.einsum("pk,pki->pi", weights, np.asarray(x[vertices]))
    gap = np.asarray(distance)[:, None] * np.asarray(direction)
    assert np.linalg.norm(direction, axis=1) == pytest.approx(1, abs=1e-12)
    assert place + gap == pytest.approx(np.asarray(points), abs=1e-12)


def test_residuals_move_with_the_vertices_as_described(surface, sheet):
    points, x = surface
    _, direction, vertices, weights = residuals(points, EVERY, x, sheet.faces)
    motion = jax.random.normal(jax.random.key(0), x.shape)
    distance = lambda x: residuals(points, EVERY, x, sheet.faces)[0]
    expected = directional_difference(distance, x, motion, 1e-7)
    described = -jnp.einsum("pi,pk,pki->p", direction, weights, motion[vertices])
    assert np.asarray(described) == pytest.approx(np.asarray(expected), abs=1e-5)


def test_residuals_of_masked_points_are_zero(surface, sheet):
    points, x = surface
    distance, *_ = residuals(points, jnp.arange(40) % 2 == 0, x, sheet.faces)
    assert jnp.all(distance[1::2] == 0) and jnp.all(distance[::2] > 0)


def test_a_point_on_the_sheet_has_the_normal_as_direction(sheet):
    points = jnp.array([[0.07, 0.11, 0.0]])
    distance, direction, *_ = surface_residuals(points, EVERY[:1], flat(sheet), sheet.faces)
    assert distance[0] < 1e-12
    assert np.asarray(direction[0]) == pytest.approx(np.array([0, 0, 1]), abs=1e-12)


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
        return jnp.mean(squared(found[0]))

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
    assert robust(near, 5e-3) == pytest.approx(0.5e-8, rel=1e-3)
    assert robust(far, 5e-3) == pytest.approx(5e-3**2 / 2, rel=1e-2)
    pull = lambda scale: float(robust_weight(far, scale) * far)
    assert pull(5e-3) < 1e-3 * pull(0.0)


def test_the_robust_loss_is_quadratic_near_and_flat_far():
    assert robust(jnp.array(1e-5)) == pytest.approx(0.5e-10, rel=1e-6)
    assert robust_weight(jnp.array(OUTLIER_SCALE)) == pytest.approx(0.5)
    far = robust(jnp.array([1.0, 2.0]))
    assert far[1] - far[0] == pytest.approx(OUTLIER_SCALE**2 * np.log(2), rel=1e-3)


def test_huber_is_smooth_and_grows_like_a_line():
    near, far = jnp.array(1e-3), jnp.array([1.0, 2.0])
    assert huber(near) == squared(near)
    assert jnp.diff(huber(far))[0] == pytest.approx(0.01)
    slope = jax.grad(huber)
    assert slope(jnp.array(0.01 - 1e-9)) == pytest.approx(float(slope(jnp.array(0.01 + 1e-9))))


@given(st.integers(1, 40), st.floats(0.05, 1.0))
@settings(max_examples=25, deadline=None)
def test_a_trimmed_mean_is_that_of_the_least_values(count, share):
    values = np.random.default_rng(count).uniform(size=40)
    mask = np.arange(40) < count
    kept = np.sort(values[mask])[: int(np.ceil(share * count))]
    found = trimmed_mean(jnp.asarray(values), jnp.asarray(mask), share)
    assert found == pytest.approx(kept.mean(), rel=1e-12)


def test_a_trimmed_mean_needs_a_share():
    with pytest.raises(ValueError, match="share"):
        trimmed_mean(jnp.ones(3), jnp.ones(3, bool), 0.0)


def test_one_sided_losses_see_one_side(surface, sheet):
    points, x = surface
    near = to_surface(points, EVERY, x, sheet.faces, squared)
    distance, *_ = residuals(points, EVERY, x, sheet.faces)
    assert near == pytest.approx(float(jnp.mean(distance**2)) / 2)
    half = jnp.arange(40) < 20
    samples = points[:30] + jnp.array([[0.0, 0.0, 0.01]])
    visible = jnp.arange(30) < 10
    found = from_surface(samples, visible, points, half)
    nearest = np.linalg.norm(np.asarray(samples)[:10, None] - np.asarray(points)[None, :20], axis=2)
    assert found == pytest.approx(np.mean(nearest.min(axis=1) ** 2) / 2)
    assert from_surface(points[:5], jnp.ones(5, bool), points, half) == 0


def test_sinkhorn_is_zero_for_the_same_cloud_and_half_the_square_of_a_shift(clouds):
    points, _ = clouds
    assert abs(float(sinkhorn(points, EVERY, points, EVERY))) < 1e-9
    shift = jnp.array([[0.03, -0.01, 0.02]])
    found = sinkhorn(points, EVERY, points + shift, EVERY, 0.05, 200)
    assert found == pytest.approx(float(jnp.sum(shift**2)) / 2, rel=0.02)


def test_the_gradient_of_sinkhorn_agrees_with_differences(clouds):
    points, targets = clouds
    mask = jnp.arange(40) < 35
    visible = jnp.arange(30) < 25
    loss = jax.jit(lambda x: sinkhorn(points, mask, x, visible, 0.2, 400))
    direction = jax.random.normal(jax.random.key(0), targets.shape)
    expected = directional_difference(loss, targets, direction, 1e-5)
    gradient = jax.grad(loss)(targets)
    assert float(jnp.sum(gradient * direction)) == pytest.approx(float(expected), rel=1e-5)
    assert jnp.all(gradient[25:] == 0) and jnp.all(jnp.isfinite(gradient))


def test_sinkhorn_sees_what_nearest_points_do_not():
    """Two halves of a cloud on top of each other lie on the whole, yet are not the whole."""
    line = jnp.linspace(0.0, 1.0, 40)
    whole = jnp.stack([line, 0 * line, 0 * line], axis=1)
    folded = whole.at[:, 0].set(jnp.where(line > 0.5, 1 - line, line))
    assert one_sided_chamfer(folded, EVERY, whole) < 1e-3
    assert sinkhorn(folded, EVERY, whole, EVERY) > 0.02
