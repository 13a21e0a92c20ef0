"""Where a bound holds a parameter, the others go to where they are best with it held."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from r2s.estimation.bounded import bounded_step, held_back, only_held, room

from r2s import scenarios
from r2s.estimation.gauss_newton import MARGIN, Descent, Normal, theta_length
from r2s.estimation.mesh_bias import _posterior
from r2s.estimation.prediction import theta_length
from r2s.estimation.problem import Problem
from r2s.materials import presets
from r2s.materials.informed_space import InformedSpace
from r2s.materials.parameters import IsotropicSpace
from r2s.scenarios import synthetic

SHAPE = (3, 3)
DIM = 2
PLACE = np.array([0.5, 1 - MARGIN])  # the second at its bound


@pytest.fixture(scope="module")
def problems():
    """A short lift of a fabric of which the prior knows as much as of every nuisance."""
    fabric = presets.grey_interlock()
    space = IsotropicSpace.make(float(fabric.density))
    known = InformedSpace.make(space, jnp.full(space.dim, 0.5), jnp.eye(space.dim))
    experiment = scenarios.lifting(num_frames=4, interval=1 / 10, height=0.2, moving=0.3)
    seen = synthetic.record(experiment, fabric, "lift", shape=SHAPE, key=jr.key(0))
    return (Problem.make(seen, known, shape=SHAPE),)


def _end(theta, gradient, matrix) -> Descent:
    none = jnp.zeros(())
    normal = Normal(
        none, none, none, jnp.asarray(gradient), jnp.asarray(matrix), 0 * jnp.asarray(matrix)
    )
    return Descent(jnp.asarray(theta), normal, none, none, none, jnp.zeros((), int))


@pytest.fixture
def recorded(problems):
    """A recording that leads beyond a bound, with its information and where its end stands."""
    known = np.eye(theta_length(problems))
    size = len(known)
    root = np.random.default_rng(0).normal(size=(size, 2 * size))
    told = 100 * root @ root.T
    theta = np.zeros(size)
    theta[:DIM] = PLACE
    peak = np.array(theta)
    peak[1] += 0.3
    free = np.arange(size) != 1
    mean = np.where(np.arange(size) < DIM, 0.5, 0.0)
    # the end: all but what the bound holds are where recording and prior balance
    whole, right = told + known, told @ peak + known @ mean
    held = right[free] - whole[np.ix_(free, ~free)] @ theta[~free]
    theta[free] = np.linalg.solve(whole[np.ix_(free, free)], held)
    assert np.all((theta[:DIM] > 0) & (theta[:DIM] < 1))
    return problems, _end(theta, told @ (theta - peak), told), told, known, peak, mean


def test_a_step_inside_is_that_of_newton_and_one_beyond_a_bound_that_of_the_others():
    random = np.random.default_rng(1)
    root, gradient = random.normal(size=(5, 9)), random.normal(size=5)
    matrix = root @ root.T
    free = np.linalg.solve(matrix, -gradient)
    wide = np.full(5, 10.0)
    np.testing.assert_allclose(bounded_step(gradient, matrix, (-wide, wide)), free, rtol=1e-9)
    down, up = -wide, np.array(wide)
    up[2] = free[2] - 0.2
    found = bounded_step(gradient, matrix, (down, up))
    others = np.arange(5) != 2
    alone = np.linalg.solve(
        matrix[np.ix_(others, others)], -gradient[others] - matrix[others, 2] * up[2]
    )
    assert found[2] == pytest.approx(up[2])
    np.testing.assert_allclose(found[others], alone, rtol=1e-9)
    assert np.isnan(bounded_step(np.full(5, np.nan), matrix, (down, up))).all()


def test_a_step_without_bounds_would_lead_the_others_away(recorded):
    """What a bound holds is no wish of the others: the end stays where it is."""
    problems, end, told, known, *_ = recorded
    theta = np.asarray(end.theta)
    way, _ = _posterior(problems, end, jnp.ones(()), np.linalg.inv(told + known))
    np.testing.assert_allclose(way, 0, atol=1e-7)
    back = held_back(problems, end, 1.0)
    assert back[1] > 0.2 and np.abs(np.delete(back, 1)).max() > 0.01
    inside = _end(np.where(np.arange(len(theta)) == 1, 0.5, theta), end.normal.gradient, told)
    np.testing.assert_allclose(held_back(problems, inside, 1.0), 0, atol=1e-12)


def test_recordings_that_err_by_more_leave_a_bound_where_the_prior_says_so(recorded):
    problems, end, told, known, peak, mean = recorded
    less = told / 1e4
    expected = np.linalg.solve(less + known, less @ peak + known @ mean)
    assert expected[1] < 1 - MARGIN
    errors = np.linalg.inv(less + known)
    way, _ = _posterior(problems, end, jnp.ones(()), errors)
    np.testing.assert_allclose(np.asarray(end.theta) + way, expected, rtol=1e-5, atol=1e-6)


def test_room_is_to_the_bounds_and_nuisances_have_no_end(problems):
    theta = np.zeros(theta_length(problems))
    theta[:DIM] = PLACE
    down, up = room(problems, jnp.asarray(theta))
    np.testing.assert_allclose(down[:DIM], MARGIN - PLACE, atol=1e-9)
    np.testing.assert_allclose(up[:DIM], 1 - MARGIN - PLACE, atol=1e-9)
    assert np.all(np.isinf(down[DIM:])) and np.all(np.isinf(up[DIM:]))
    held = only_held((down, up))
    assert held[1][1] == 0 and np.isinf(held[0]).all() and np.isinf(np.delete(held[1], 1)).all()


def test_a_bound_is_held_in_single_precision_too(problems):
    """Where the least place, 1e-3, is a little more than itself, and the largest a little less."""
    ends = np.array([MARGIN, 1 - MARGIN])
    theta = np.zeros(theta_length(problems), np.float32)
    theta[:DIM] = ends
    assert np.any(theta[:DIM].astype(float) != ends)
    low, high = only_held(room(problems, jnp.asarray(theta, jnp.float32)))
    assert low[0] == 0 and high[1] == 0
    assert np.isinf(high[0]) and np.isinf(low[1])
