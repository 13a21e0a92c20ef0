"""Damped Gauss-Newton steps within bounds: facts of least squares, and scipy's answers."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from scipy import optimize

from r2s.estimation.least_squares import BoundedGaussNewton, Damping, proposed

TIGHT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


def solved(residual, start, max_steps=200, **settings):
    solver = BoundedGaussNewton(**TIGHT | settings)
    return optimistix.least_squares(residual, solver, start, throw=False, max_steps=max_steps)


def line(matrix, right):
    return lambda y, _: matrix @ y - right


@pytest.fixture
def problem():
    random = np.random.default_rng(0)
    return jnp.asarray(random.normal(size=(9, 4))), jnp.asarray(random.normal(size=9))


def test_a_bound_that_holds_one_number_leaves_the_others_at_their_least_squares(problem):
    matrix, right = problem
    free = np.linalg.lstsq(matrix, right, None)[0]
    low, high = np.full(4, -10.0), np.full(4, 10.0)
    high[0], low[2] = free[0] - 0.3, free[2] + 0.2
    found = solved(line(matrix, right), jnp.zeros(4).at[0].set(-1.0), low=low, high=high)
    expected = optimize.lsq_linear(np.asarray(matrix), np.asarray(right), (low, high)).x
    assert found.result == optimistix.RESULTS.successful
    np.testing.assert_allclose(found.value, expected, atol=1e-8)


def test_curved_residuals_within_bounds_end_where_those_of_scipy_do():
    def residual(y, _):
        return jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0], jnp.exp(-y[1]) - 0.2])

    low, high = np.array([-2.0, -1.0]), np.array([0.8, 3.0])
    found = solved(residual, jnp.array([-1.2, 1.0]), low=low, high=high)
    expected = optimize.least_squares(
        lambda y: np.asarray(residual(y, None)), [-1.2, 1.0], bounds=(low, high), xtol=1e-12
    )
    np.testing.assert_allclose(found.value, expected.x, atol=1e-6)
    assert found.stats["loss"] == pytest.approx(expected.cost, rel=1e-8)


def test_a_number_that_nothing_tells_stays_where_it_is():
    matrix = jnp.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    found = solved(line(matrix, jnp.array([2.0, 4.0])), jnp.array([0.0, 0.5, 0.7]))
    assert found.value[2] == pytest.approx(0.7, abs=1e-12)
    np.testing.assert_allclose(matrix @ found.value, [2.0, 4.0], atol=1e-8)


def test_with_a_prior_it_ends_at_the_mean_of_the_posterior(problem):
    matrix, right = problem
    root = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4)))
    precision, mean = root @ root.T + jnp.eye(4), jnp.arange(4.0)
    found = solved(line(matrix, right), jnp.zeros(4), mean=mean, precision=precision)
    whole = matrix.T @ matrix + precision
    expected = np.linalg.solve(whole, matrix.T @ right + precision @ mean)
    np.testing.assert_allclose(found.value, expected, atol=1e-8)
    np.testing.assert_allclose(found.stats["matrix"], whole, rtol=1e-9)


def test_where_an_evaluation_fails_the_next_step_is_shorter():
    def residual(y, _):
        return jnp.where(y < 2.0, (y - 1.5) * (1 + 20 * (y - 1.5)), jnp.nan)

    found = solved(residual, jnp.array([1.476]))  # whose first step leads beyond 2
    assert found.result == optimistix.RESULTS.successful
    assert abs(residual(found.value, None)[0]) < 1e-6
    nowhere = solved(residual, jnp.array([3.0]))
    assert nowhere.result != optimistix.RESULTS.successful
    np.testing.assert_allclose(nowhere.value, 3.0)
    assert nowhere.stats["num_steps"] == 1  # the same place would fail again


def test_a_step_is_no_longer_than_allowed(problem):
    matrix, right = problem
    start, square = jnp.full(4, 5.0), matrix.T @ matrix
    limits = jnp.full(4, -jnp.inf), jnp.full(4, jnp.inf)
    gradient = matrix.T @ (matrix @ start - right)
    free = proposed(start, gradient, square, Damping.initial(), *limits) - start
    held = proposed(start, gradient, square, Damping.initial(), *limits, 0.2) - start
    assert np.max(np.abs(held)) == pytest.approx(0.2)
    np.testing.assert_allclose(held / 0.2, free / np.max(np.abs(free)), rtol=1e-9)  # as a whole
