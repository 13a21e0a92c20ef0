"""What half of a pull tells of a stiffness that was taken as constant."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation.gauss_newton import Descent, Normal
from r2s.estimation.prediction import Prediction, Sensitivity, theta_length
from r2s.estimation.problem import Force, Problem
from r2s.estimation.standard_errors import half_pulled, model_error, to_small_strain
from r2s.materials.parameters import OrthotropicSpace, ParameterSpace
from r2s.materials.stiffening_space import StiffeningSpace
from r2s.scenarios import stretching

FRAMES, NOISE, SCALE = 40, 2e-3, 1.0  # -, [N], of the force at the end of the pull [N]
STRETCH = np.linspace(0, 1, FRAMES)  # of that at the end
SPACE = OrthotropicSpace.make(0.2)
WIDTH = SPACE.ranges[0].width  # of the logarithm of the warp's stiffness


def fitted(growth, seed=0, space: ParameterSpace = SPACE):
    """A pull whose stiffness grows, and what a constant one of the warp predicts of its force where
    it fits best: the problem, its end, the prediction, and the place of the stiffness at rest less
    that of the fit."""
    scenario = stretching(num_frames=FRAMES).scenario((3, 3))
    measured = SCALE * STRETCH * (1 + growth * STRETCH)
    measured = measured + NOISE * np.random.default_rng(seed).normal(size=FRAMES)
    force = Force(
        jnp.asarray(measured[:, None], float), jnp.ones(FRAMES, bool), jnp.array([[1.0, 0, 0]])
    )
    problem = Problem(scenario, space, tuple(range(FRAMES)), force=force)
    best = measured @ STRETCH / (STRETCH @ STRETCH)
    x = jnp.zeros((FRAMES, len(scenario.start), 3))
    size = theta_length((problem,))
    slope = np.zeros((FRAMES, 1, size))
    slope[:, 0, 0] = best * STRETCH * WIDTH
    seen = Prediction(x, jnp.asarray(best * STRETCH[:, None], float), jnp.asarray(True))
    sensitivity = Sensitivity(jnp.zeros((*x.shape, size)), jnp.asarray(slope, float))
    number, none, square = jnp.zeros(()), jnp.zeros(size), jnp.zeros((size, size))
    normal = Normal(number, number, number, none, square, square)
    theta = none.at[: space.dim].set(0.5)
    end = Descent(theta, normal, number, number, number, jnp.zeros((), int))
    return problem, end, (seen, sensitivity), np.log(SCALE / best) / WIDTH


def error_of(growth, seed=0, space: ParameterSpace = SPACE):
    problem, end, predicted, off = fitted(growth, seed, space)
    return model_error((problem,), end, jnp.asarray(1e-9), [predicted])[: space.dim], off


@pytest.mark.parametrize("growth", [0.1, 0.5])
def test_the_stiffness_at_rest_is_as_far_as_half_of_the_pull_says(growth):
    found, off = error_of(growth)
    assert abs(off) > 0.5 * growth / (1 + growth) / WIDTH
    np.testing.assert_allclose(found[0], off, rtol=0.35)
    np.testing.assert_allclose(found[1:], 0, atol=1e-6)  # of which the force says nothing


def test_a_stiffness_that_is_constant_errs_by_its_noise():
    """The error of half a pull is noise then, and what is counted beyond it is as large at most."""
    found = [error_of(0.0, seed)[0][0] * WIDTH for seed in range(40)]
    half = STRETCH <= 0.5
    noise = NOISE / SCALE / np.sqrt(np.sum(STRETCH[half] ** 2))
    assert np.median(np.abs(found)) < 2 * noise
    assert np.sqrt(np.mean(np.square(found))) < 3 * noise
    assert np.mean(np.equal(found, 0)) > 0.4


def test_yarns_that_may_stiffen_and_pulls_without_force_have_no_such_error():
    assert not np.any(error_of(0.5, space=StiffeningSpace.make(SPACE))[0])
    problem, end, predicted, _ = fitted(0.5)
    without = Problem(problem.scenario, SPACE, problem.frames)
    assert half_pulled(without) is without
    assert not np.any(model_error((without,), end, jnp.asarray(1e-9), [predicted]))


def test_half_of_a_pull_ends_in_the_middle_of_its_force():
    problem, *_ = fitted(0.0)
    assert problem.force is not None
    taut = dataclasses.replace(problem.force, values=problem.force.values + 3)  # from the start
    half = half_pulled(dataclasses.replace(problem, force=taut))
    assert half.force is not None
    np.testing.assert_array_equal(np.asarray(half.force.seen), STRETCH < 0.5)


def test_a_change_within_its_noise_is_none():
    change, variance = np.array([0.1, -0.1, 0.1]), np.array([0.02, 0.0, -1.0])
    np.testing.assert_allclose(to_small_strain(change, variance), [0, -0.2, 0.2])
