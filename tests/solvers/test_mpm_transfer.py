"""Transfers between particles and grid: sums, transposes, derivatives; the grid itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import directional_difference

from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.transfer import affine_factor, g2p, g2p_plain, p2g, p2g_plain

COUNT, CHANNELS = 7, 2


@pytest.fixture(scope="module", params=[2, 3])
def case(request):
    """A grid, and random particles, values, slopes and nodes."""
    axes, rng = request.param, np.random.default_rng(0)
    grid = Grid((-1.0, 0.5, 2.0)[:axes], 0.1, (8, 7, 6)[:axes])
    x = np.asarray(grid.lower) + rng.uniform(0.1, 0.35, (COUNT, axes))
    values = rng.normal(size=(COUNT, CHANNELS))
    slopes = rng.normal(size=(COUNT, CHANNELS, axes))
    nodes = rng.normal(size=(np.prod(grid.shape), CHANNELS))
    return grid, *(jnp.asarray(part) for part in (x, values, slopes, nodes))


def test_what_is_spread_sums_to_what_there_was(case):
    grid, x, values, slopes, _ = case
    nodes = p2g(grid, x, values, slopes)
    assert jnp.sum(nodes, axis=0) == pytest.approx(np.asarray(jnp.sum(values, axis=0)), abs=1e-13)


def test_an_affine_field_is_collected_exactly(case):
    grid, x, values, slopes, _ = case
    where = jnp.stack([jnp.broadcast_to(a, grid.shape).reshape(-1) for a in grid.axes], axis=1)
    nodes = values[0][None] + where @ slopes[0].T
    value, moment = g2p(grid, x, nodes)
    assert value == pytest.approx(np.asarray(values[0][None] + x @ slopes[0].T), abs=1e-12)
    expected = np.broadcast_to(slopes[0], moment.shape)
    assert affine_factor(grid) * moment == pytest.approx(expected, abs=1e-11)


def test_each_is_the_transpose_of_the_other(case):
    grid, x, values, slopes, nodes = case
    value, moment = g2p(grid, x, nodes)
    there = jnp.sum(p2g(grid, x, values, slopes) * nodes)
    assert there == pytest.approx(float(jnp.sum(value * values) + jnp.sum(moment * slopes)))


@pytest.mark.slow(group="mpm")
def test_the_reverse_rules_equal_those_of_jax(case):
    grid, x, values, slopes, nodes = case
    for fast, plain, inputs in (
        (p2g, p2g_plain, (x, values, slopes)),
        (g2p, g2p_plain, (x, nodes)),
    ):
        found, expected = _slopes(fast, grid, inputs), _slopes(plain, grid, inputs)
        for a, b in zip(found, expected, strict=True):
            assert a == pytest.approx(np.asarray(b), rel=1e-10, abs=1e-12)


def _slopes(transfer, grid, inputs):
    """Derivatives of a nonlinear sum of a transfer's results."""

    def weigh(out):
        return sum(jnp.sum(jnp.sin(part)) for part in jax.tree.leaves(out))

    def loss(*inputs):
        return weigh(transfer(grid, *inputs))

    return jax.grad(loss, argnums=tuple(range(len(inputs))))(*inputs)  # jit would take longer


def test_forward_mode_equals_differences(case):
    grid, x, _, _, nodes = case

    def get(x):
        return g2p_plain(grid, x, nodes)[0]

    direction = jnp.ones_like(x)
    _, found = jax.jvp(get, (x,), (direction,))
    expected = directional_difference(get, x, direction, 1e-6)
    assert found == pytest.approx(np.asarray(expected), abs=1e-7)


def test_a_grid_covers_what_it_should():
    grid = Grid.covering((0.0, -1.0), (1.0, 1.0), 0.1)
    corners = jnp.array([[0.0, -1.0], [1.0, 1.0], [0.5, 0.0]])
    assert grid.inside(corners).all()
    assert np.min(np.abs(np.asarray(grid.axes[1]) + 1)) < 1e-12  # a node at the lower end
    grid.check(corners)
    with pytest.raises(ValueError, match="1 particles are outside the grid.*they may be from"):
        grid.check(corners.at[1, 0].set(3.0))
    assert not grid.inside(jnp.array([[jnp.nan, 0.0]])).any()


def test_an_impossible_grid_is_refused():
    with pytest.raises(ValueError, match="2 or 3 axes"):
        Grid((0.0,), 0.1, (8,))
    with pytest.raises(ValueError, match="spacing"):
        Grid((0.0, 0.0), 0.0, (8, 8))
    with pytest.raises(ValueError, match="lower < upper"):
        Grid.covering((0.0, 0.0), (1.0, 0.0), 0.1)
