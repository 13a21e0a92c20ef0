"""Standard errors: of a smooth loss, of a rough one, and of a law that is not constant."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import FABRIC, FAMILY, end_at, short_problem, valley

from r2s.estimation import gauss_newton
from r2s.estimation.gauss_newton import normals_at
from r2s.estimation.method import Budget
from r2s.estimation.prediction import Prediction, Sensitivity, theta_length
from r2s.estimation.problem import Force, Problem
from r2s.estimation.standard_errors import (
    FARTHEST,
    covariance,
    covariance_at,
    half_pulled,
    model_error,
    sample_around,
    steps_apart,
    to_small_strain,
)
from r2s.materials.parameters import (
    UNIFORM_DEVIATION,
    InformedSpace,
    OrthotropicSpace,
    ParameterSpace,
    StiffeningSpace,
)
from r2s.scenarios import stretching

FRAMES, NOISE, SCALE = 40, 2e-3, 1.0  # -, [N], of the force at the end of the pull [N]
STRETCH = np.linspace(0, 1, FRAMES)  # of that at the end
SPACE = OrthotropicSpace.make(0.2)
WIDTH = SPACE.ranges[0].width  # of the logarithm of the warp's stiffness


@pytest.fixture(scope="module")
def lifted():
    return short_problem()


def errors_by(problems, end, prior, led, is_truth=False):
    """`covariance` where steps lead from places and their normal equations."""
    return covariance(problems, end, prior, steps_apart(problems, end, prior, led), is_truth)


def test_the_prior_of_theta_holds_what_is_known_of_the_fabric(lifted):
    dim = lifted.space.dim
    precision = np.diag(np.arange(1.0, dim + 1)) + 0.1
    known = InformedSpace.make(lifted.space, jnp.full(dim, 0.3), jnp.asarray(precision))
    problems = (dataclasses.replace(lifted, space=known),)
    theta = jnp.zeros(theta_length(problems))
    off, found = gauss_newton.prior_terms(problems, theta)
    np.testing.assert_allclose(off[:dim], -0.3, rtol=1e-6)
    np.testing.assert_allclose(found[:dim, :dim], precision, rtol=1e-6)
    np.testing.assert_allclose(found[dim:, dim:], np.eye(len(theta) - dim))
    end, _ = valley(lifted, len(theta))
    alone = dataclasses.replace(
        end.normal, matrix=0 * end.normal.matrix, scatter=0 * end.normal.scatter
    )
    nothing = dataclasses.replace(end, theta=theta - off, normal=alone)
    told = errors_by(problems, nothing, 1.0, [])[:dim, :dim]
    np.testing.assert_allclose(np.linalg.inv(told), precision, rtol=1e-6, atol=1e-9)


@pytest.mark.slow(group="estimates")
def test_deviations_are_those_of_a_smooth_loss_or_of_how_far_descents_lie_apart(lifted):
    problems, prior = (lifted,), 1e-9
    size = theta_length(problems)
    end, at = valley(lifted, size)
    alone = errors_by(problems, end, prior, [])
    np.testing.assert_allclose(alone, 1e-4 * jnp.linalg.inv(end.normal.matrix), rtol=1e-5)
    places = sample_around(problems, end, prior, 64, jr.key(0))
    off = places - end.theta[None]
    np.testing.assert_allclose(jnp.mean(off, axis=0), 0, atol=1e-12)  # in opposite pairs
    far = jnp.einsum("pu,uv,pv->p", off, jnp.linalg.inv(alone), off)
    np.testing.assert_allclose(far, size, rtol=1e-4)  # a deviation along each axis
    back = [(place, at(place)) for place in places]
    np.testing.assert_allclose(errors_by(problems, end, prior, back), alone, rtol=1e-6)
    # descents that would all end one way, but for one that would end anywhere
    away = jnp.linalg.cholesky(alone)[:, 0] * 5

    def push(times):
        return -end.normal.matrix @ away * times

    pushes = [1e6, *(1.0 if i % 2 else -1.0 for i in range(63))]
    led = [(place, at(place, push(t))) for place, t in zip(places, pushes, strict=True)]
    rough = errors_by(problems, end, prior, led)
    expected = alone + jnp.outer(away, away) * (63 + FARTHEST**2) / 65
    np.testing.assert_allclose(rough, expected, rtol=1e-3, atol=1e-12)
    # a run that diverged, or whose derivatives did, says that its place is no better known
    for loss, gradient in ((jnp.inf, away * jnp.nan), (1.0, away * jnp.nan), (1.0, away / 0)):
        pair = jnp.asarray(loss), gradient
        broken = eqx.tree_at(lambda n: (n.loss, n.gradient), at(end.theta), pair)
        lost = errors_by(problems, end, prior, [(place, broken) for place in places[:2]])
        assert np.all(np.isfinite(lost)) and np.all(np.diag(lost) > np.diag(alone))


def test_where_derivatives_overflow_nothing_is_known(lifted):
    problems, prior = (lifted,), 1e-9
    size = theta_length(problems)
    end, at = valley(lifted, size)
    broken = eqx.tree_at(lambda e: e.normal.scatter, end, jnp.full((size, size), jnp.inf))
    near = [(end.theta, at(end.theta))] * 2
    known = np.diag(errors_by(problems, broken, prior, near))
    dim = lifted.space.dim
    np.testing.assert_allclose(known[:dim], UNIFORM_DEVIATION**2)
    np.testing.assert_allclose(known[dim:], 1)


@pytest.mark.slow(group="estimates")
def test_deviations_hang_on_no_limit_and_hardly_on_rounding():
    """Of an end that is moved by less than single precision resolves, and of a mesh that moves
    alike: two answers would differ by far."""
    problems, budget = (short_problem(8),), Budget(num_probes=4)
    nuisances = jnp.zeros(theta_length(problems) - FAMILY.dim)
    theta, zero = jnp.concatenate([FAMILY.to_unit(FABRIC), nuisances]), jnp.zeros(())

    def found(theta, tried_on=None):
        normal = normals_at(problems, [theta], [zero])[0]
        end = dataclasses.replace(end_at(theta), normal=normal)
        return np.sqrt(np.diag(covariance_at(problems, budget, end, jr.key(0), tried_on=tried_on)))

    whole = found(theta)
    np.testing.assert_allclose(found(theta * (1 + 3e-7)), whole, rtol=0.05)
    np.testing.assert_allclose(found(theta, tried_on=(*problems,)), whole, rtol=1e-3)


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
    end = end_at(np.where(np.arange(size) < space.dim, 0.5, 0.0))
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


def test_a_change_within_its_noise_is_none():
    change, variance = np.array([0.1, -0.1, 0.1]), np.array([0.02, 0.0, -1.0])
    np.testing.assert_allclose(to_small_strain(change, variance), [0, -0.2, 0.2])


def test_the_scatter_of_a_gradient_is_that_of_the_jackknife():
    """Of a straight line through points: as if each cluster in turn had been left out."""
    random = np.random.default_rng(0)
    rows, values = random.normal(size=(6, 4, 2)), random.normal(size=(6, 4))
    whole = np.einsum("cpu,cpv->uv", rows, rows)

    def fit(kept):
        return np.linalg.lstsq(rows[kept].reshape(-1, 2), values[kept].ravel(), None)[0]

    best = fit(np.arange(6))
    scores = np.einsum("cpu,cp->cu", rows, rows @ best - values)
    left = np.stack([fit(np.arange(6) != i) - best for i in range(6)])
    matrices = np.einsum("cpu,cpv->cuv", rows, rows)
    inverse = np.linalg.inv(whole)
    clusters = jnp.asarray(scores), jnp.asarray(matrices)

    def covariance(noise):
        found = gauss_newton.scatter(*clusters, jnp.full(6, noise), jnp.zeros((2, 2)), 1.0)
        return inverse @ np.asarray(found) @ inverse

    np.testing.assert_allclose(covariance(0.0), left.T @ left, rtol=1e-9)
    # nor is it less than by independent errors, of a variance of 100 here
    np.testing.assert_allclose(covariance(100.0), 100 * inverse, rtol=1e-9)
    least = np.linalg.eigvalsh(covariance(0.1) - 0.1 * inverse)
    assert least[0] > -1e-12


def test_without_the_cluster_that_alone_tells_a_number_that_is_what_the_prior_allows():
    """The slope of a line whose points but for the last cluster's all lie in one place."""
    rows = np.ones((3, 4, 2))
    rows[:, :, 1] = np.array([0.0, 0.0, 1.0])[:, None]
    matrices, precision, weight = np.einsum("cpu,cpv->cuv", rows, rows), np.diag([4.0, 25.0]), 1e-9
    scores = np.array([[0.1, 0.0], [-0.3, 0.0], [0.2, 0.2]])  # not at the minimum of the slope
    parts = jnp.asarray(scores), jnp.asarray(matrices), jnp.zeros(3)
    found = gauss_newton.scatter(*parts, jnp.asarray(precision), weight)
    inverse = np.linalg.inv(matrices.sum(axis=0) + weight * precision)
    error = np.sqrt((inverse @ np.asarray(found) @ inverse)[1, 1])
    assert 1 / 5 < error < 1 / 4  # the others tell a little of it by the mean
