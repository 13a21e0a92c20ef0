"""The discretization error of an estimate, and what a prior and bounds make of it."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import (
    FABRIC,
    PLACE,
    SMALL,
    SPACE,
    end_at,
    problem,
    short_lift,
    short_problem,
    valley,
)

from r2s.estimation import descent, standard_errors
from r2s.estimation.descent import Run
from r2s.estimation.gauss_newton import MARGIN, held_back, only_held, room
from r2s.estimation.least_squares import bounded_step
from r2s.estimation.prediction import derivatives_at, theta_length
from r2s.estimation.problem import Force, Problem
from r2s.estimation.standard_errors import (
    OtherMesh,
    _posterior,
    coarser_of,
    factor,
    mesh_error,
    with_mesh_error,
)
from r2s.materials.parameters import InformedSpace, IsotropicSpace
from r2s.scenarios import resolution

DIM = 2
AT_BOUND = np.array([0.5, 1 - MARGIN])  # the second at its bound


@pytest.fixture(scope="module")
def end():
    """A descent that stands at the true fabric, and its derivatives."""
    problems = (problem(1.0),)
    theta = jnp.zeros(theta_length(problems)).at[:2].set(PLACE)
    run = Run(SMALL, jr.key(0), derivatives_at)
    (descent_end,) = descent._fresh(problems, run, [theta], 0.0, 0)
    return problems, descent_end, derivatives_at(problems, theta)


@pytest.mark.slow(group="estimates")
def test_the_bias_of_a_mesh_is_the_stiffness_that_its_motion_is_that_of(end):
    problems, at, seen = end
    bias, covariance = mesh_error(problems, OtherMesh(problems, 1.0), at, seen)
    np.testing.assert_allclose(bias, 0, atol=1e-9)
    np.testing.assert_allclose(covariance, 0, atol=1e-9)
    bias, covariance = mesh_error(problems, OtherMesh((problem(1.05),), 2.0), at, seen)
    assert bias[0] * SPACE.ranges[0].width == pytest.approx(2 * np.log(1.05), rel=0.2)
    assert np.linalg.eigvalsh(covariance - np.outer(bias, bias))[0] > -1e-12


@pytest.mark.slow(group="estimates")
def test_a_motion_that_fails_has_an_error_of_the_whole_range(end):
    problems, at, seen = end
    broken = eqx.tree_at(lambda p: p.scenario.path, problems[0], replace_fn=lambda p: p * jnp.nan)
    bias, covariance = mesh_error(problems, OtherMesh((broken,), 1.0), at, seen)
    np.testing.assert_allclose(bias, 1)
    np.testing.assert_allclose(covariance, np.eye(len(bias)))


def test_steps_to_finer_and_coarser_meshes_lead_to_the_same_limit():
    """An error c h^p: the step from h to h / 2 and that from h to 2 h, times their factors."""
    order, error = resolution.ORDER, 0.3
    finer = error * (1 - 0.5**order) * factor(0.5)
    coarser = error * (1 - 2.0**order) * factor(2.0)
    assert finer == pytest.approx(error) and coarser == pytest.approx(error)


@pytest.fixture(scope="module")
def lifted():
    return short_problem()


def staying(lifted, raw, off, bias):
    """The variance and bias of an end whose prior has a variance of 1/16 for each number of a
    fabric, and its mean `off` by so much; `raw` is the variance without the prior."""
    dim, size = lifted.space.dim, theta_length((lifted,))
    known = np.eye(size)
    known[:dim, :dim] *= 16
    end, _ = valley(lifted, size)
    mean = end.theta[:dim] - off
    space = InformedSpace.make(lifted.space, mean, jnp.asarray(known[:dim, :dim], float))
    problems = (dataclasses.replace(lifted, space=space),)
    away = np.r_[np.full(dim, off), np.zeros(size - dim)]
    told = dataclasses.replace(  # arrived: recordings and prior pull alike
        end.normal, matrix=1e4 * jnp.eye(size), gradient=jnp.asarray(-known @ away)
    )
    end = dataclasses.replace(end, normal=told)
    covariance = np.diag(np.r_[raw, np.full(size - 1, 1e-4)])
    theirs = np.r_[bias, np.zeros(size - 1)]
    other, one = OtherMesh((lifted,), factor(0.5)), jnp.ones(())
    error = theirs, np.outer(theirs, theirs)
    at, flat, _ = with_mesh_error((lifted,), other, end, one, covariance, error)
    there, found, left = with_mesh_error(problems, other, end, one, covariance, error)
    assert at is end.theta and there is end.theta
    assert left[0] <= np.sqrt(found[0, 0])
    np.testing.assert_allclose(flat, covariance + np.diag(theirs**2))
    assert np.linalg.eigvalsh(flat - found)[0] > -1e-9  # never wider for what is known
    np.testing.assert_allclose(np.diag(found)[1:], 1e-4, rtol=2e-2)
    return found[0, 0], left[0]


def test_what_is_known_limits_the_errors_of_an_estimate_that_stays_but_for_the_way(lifted):
    close, _ = staying(lifted, 4.0, 0.05, 0.0)
    np.testing.assert_allclose(close, 1 / 16 + 0.05**2, rtol=1e-3)
    by_mesh, left = staying(lifted, 1e-4, 0.05, 0.9)
    np.testing.assert_allclose(by_mesh, 1 / 16 + 0.05**2, rtol=2e-2)
    assert left == pytest.approx(0.255, abs=0.01)
    far, _ = staying(lifted, 0.04, 2.5, 0.0)  # eight standard deviations of the prior
    np.testing.assert_allclose(far, 0.04, rtol=1e-3)


def test_an_exact_fit_has_the_error_of_its_mesh(lifted):
    """Its own variance is below the least number of single precision."""
    size = theta_length((lifted,))
    end, _ = valley(lifted, size)
    of_mesh = np.diag(np.full(size, 0.04))
    other, error = OtherMesh((lifted,), factor(0.5)), (np.full(size, 0.2), of_mesh)
    nothing = np.zeros((size, size))
    _, found, _ = with_mesh_error((lifted,), other, end, jnp.ones(()), nothing, error)
    np.testing.assert_allclose(found, of_mesh, atol=1e-9)


def test_what_tests_measured_draws_an_estimate_only_as_far_as_the_finer_mesh_allows(
    lifted, monkeypatch
):
    """All the way where that fits as well there, half of it where only that does, else not."""
    dim, size = lifted.space.dim, theta_length((lifted,))
    end, _ = valley(lifted, size)
    mean, known = end.theta[:dim] - 0.1, 1e4 * jnp.eye(dim)
    space = InformedSpace.make(lifted.space, mean, known, measured=True)
    problems = (dataclasses.replace(lifted, space=space),)
    normal = dataclasses.replace(
        end.normal, matrix=1e4 * jnp.eye(size), gradient=jnp.zeros(size).at[:dim].set(-1e3)
    )
    end, one = dataclasses.replace(end, normal=normal), jnp.ones(())
    bias = np.r_[np.full(dim, 0.5), np.zeros(size - dim)]
    covariance = np.diag(np.r_[np.full(dim, 0.25), np.full(size - dim, 1e-4)])

    def went(limit, ratio=0.5):
        def loss(_, theta, scale):
            assert scale is end.scale
            return 1.0 if float(end.theta[0] - theta[0]) <= limit else 2.0

        monkeypatch.setattr(standard_errors, "predictions_at", lambda _, theta: theta)
        monkeypatch.setattr(standard_errors, "loss_from", loss)
        other, error = OtherMesh(problems, factor(ratio)), (bias, np.diag(bias**2))
        theta, errors, _ = with_mesh_error(problems, other, end, one, covariance, error)
        return float(end.theta[0] - theta[0]), np.sqrt(errors[0, 0])

    whole, error = went(1.0)
    assert whole == pytest.approx(0.1, rel=0.01) and error == pytest.approx(0.01, rel=0.01)
    half, error = went(0.6 * whole)
    assert half == pytest.approx(whole / 2, rel=1e-5)
    assert error == pytest.approx(np.hypot(0.01, whole / 2), rel=0.01)  # which hold what is left
    assert went(1e-4)[0] == 0 and went(1.0, ratio=2.0)[0] == 0  # a coarser mesh allows nothing


def test_the_coarser_of_two_meshes_is_the_same_from_either_but_for_pulls(lifted):
    coarse, fine = [tuple(dataclasses.replace(lifted) for _ in range(2)) for _ in range(2)]
    to_finer, to_coarser = OtherMesh(fine, factor(0.5)), OtherMesh(coarse, factor(2.0))
    for problems, other in ((coarse, to_finer), (fine, to_coarser)):
        found, beside = coarser_of(problems, other)
        for which in (0, 1):
            assert found[which] is coarse[which] and beside[which].problems[0] is fine[which]
            assert beside[which].factor == to_finer.factor
    found, beside = coarser_of((pull(fine[0]), fine[1]), to_coarser)
    assert found[0].is_pulled and found[1] is coarse[1]
    assert beside[0].problems[0] is coarse[0] and beside[0].factor == to_coarser.factor
    assert beside[1].problems[0] is fine[1] and beside[1].factor == to_finer.factor


def pull(problem: Problem) -> Problem:
    """The problem with a force, as that of a pull."""
    count = len(problem.frames)
    force = Force(jnp.zeros((count, 1)), jnp.ones(count, bool), jnp.eye(3)[:1])
    return dataclasses.replace(problem, force=force)


@pytest.fixture(scope="module")
def problems():
    """A short lift of a fabric of which the prior knows as much as of every nuisance."""
    space = IsotropicSpace.make(float(FABRIC.density))
    known = InformedSpace.make(space, jnp.full(space.dim, 0.5), jnp.eye(space.dim))
    return (Problem.make(short_lift(), known, shape=(4, 4)),)


@pytest.fixture
def recorded(problems):
    """A recording that leads beyond a bound, with its information and where its end stands."""
    known = np.eye(theta_length(problems))
    size = len(known)
    root = np.random.default_rng(0).normal(size=(size, 2 * size))
    told = 100 * root @ root.T
    theta = np.zeros(size)
    theta[:DIM] = AT_BOUND
    peak = np.array(theta)
    peak[1] += 0.3
    free = np.arange(size) != 1
    mean = np.where(np.arange(size) < DIM, 0.5, 0.0)
    # the end: all but what the bound holds are where recording and prior balance
    whole, right = told + known, told @ peak + known @ mean
    held = right[free] - whole[np.ix_(free, ~free)] @ theta[~free]
    theta[free] = np.linalg.solve(whole[np.ix_(free, free)], held)
    assert np.all((theta[:DIM] > 0) & (theta[:DIM] < 1))
    return problems, end_at(theta, 0.0, told @ (theta - peak), told), told, known


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
    problems, end, told, known = recorded
    theta = np.asarray(end.theta)
    way, _ = _posterior(problems, end, jnp.ones(()), np.linalg.inv(told + known))
    np.testing.assert_allclose(way, 0, atol=1e-7)
    back = held_back(problems, end, 1.0)
    assert back[1] > 0.2 and np.abs(np.delete(back, 1)).max() > 0.01
    inside = end_at(np.where(np.arange(len(theta)) == 1, 0.5, theta), 0, end.normal.gradient, told)
    np.testing.assert_allclose(held_back(problems, inside, 1.0), 0, atol=1e-12)


def test_room_is_to_the_bounds_and_nuisances_have_no_end(problems):
    theta = np.zeros(theta_length(problems))
    theta[:DIM] = AT_BOUND
    down, up = room(problems, jnp.asarray(theta))
    np.testing.assert_allclose(down[:DIM], MARGIN - AT_BOUND, atol=1e-9)
    np.testing.assert_allclose(up[:DIM], 1 - MARGIN - AT_BOUND, atol=1e-9)
    assert np.all(np.isinf(down[DIM:])) and np.all(np.isinf(up[DIM:]))
    for kind in (float, np.float32):  # in which the largest place is a little less
        held = only_held(room(problems, jnp.asarray(theta, kind)))
        assert held[1][1] == 0 and np.isinf(held[0]).all() and np.isinf(np.delete(held[1], 1)).all()
