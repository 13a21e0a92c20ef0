"""Runs that diverge end no estimate as if it had arrived: another descent goes on, or none does."""

import dataclasses

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import FABRIC, end_at, short_lift

from r2s.estimation import descent, gauss_newton, methods, standard_errors
from r2s.estimation.descent import Run
from r2s.estimation.judgement import NO_DERIVATIVE, with_uncertainty
from r2s.estimation.method import Budget
from r2s.estimation.prediction import derivatives_at, theta_length
from r2s.estimation.problem import Problem
from r2s.estimation.standard_errors import OtherMesh
from r2s.materials import prior
from r2s.materials.parameters import IsotropicSpace, OrthotropicSpace

RUN = Run(Budget(frame_fractions=(0.25, 0.5), num_starts=2), jr.key(0), derivatives_at)


@pytest.fixture(scope="module")
def problem():
    return Problem.make(short_lift(), IsotropicSpace.make(float(FABRIC.density)), shape=(4, 4))


def row_of(problem, losses):
    """Descents of the first stage with such losses, each in a place of its own."""
    size = theta_length((problem,))
    return [end_at(np.full(size, i), loss, 0, np.eye(size)) for i, loss in enumerate(losses)]


def fresh(losses):
    """Instead of new descents: whose losses, once all frames count, are those of their places."""

    def made(problems, run, thetas, scale, stage):
        shared = 0 < stage <= len(run.budget.frame_fractions)
        row = [end_at(t, 1e-6 if shared else losses[int(t[0])], scale=scale) for t in thetas]
        return [dataclasses.replace(end, stage=jnp.asarray(stage)) for end in row]

    return made


def test_the_next_best_descent_goes_on_where_the_best_diverges_later(problem, monkeypatch):
    row = row_of(problem, [1e-6, 2e-6])
    monkeypatch.setattr(descent, "_fresh", fresh([np.inf, 3e-6]))
    stages = []
    while row is not None:
        stages.append(descent._best(row))
        row = descent._next_stage((problem,), RUN, row)
    assert [which for which, _ in stages] == [0, 0, 0, 1]
    assert float(stages[-1][1].normal.loss) == pytest.approx(3e-6)


def test_where_all_diverge_it_is_said_and_why(problem, monkeypatch):
    monkeypatch.setattr(descent, "_fresh", fresh([np.inf, np.inf]))
    monkeypatch.setattr(descent, "explain", lambda *_: "frame 3: speed.")
    row = descent._next_stage((problem,), RUN, row_of(problem, [1e-6, 2e-6]))
    with pytest.raises(
        RuntimeError, match="all descents diverged, the first frame 3: speed. Check"
    ):
        while row is not None:
            row = descent._next_stage((problem,), RUN, row)
    with pytest.raises(RuntimeError, match="all starts of the descents diverged"):
        descent.multi_start((problem,), RUN.near())


def test_cma_es_gives_no_fabric_of_runs_that_all_diverged(problem, monkeypatch):
    pytest.importorskip("cma")
    monkeypatch.setattr(methods, "_losses", lambda problems, thetas: jnp.full(len(thetas), jnp.inf))
    with pytest.raises(RuntimeError, match="all .* simulations of CMA-ES diverged"):
        methods.cma_es((problem,), 30, key=jr.key(0))


def test_the_key_alone_decides_what_cma_es_tries(problem, monkeypatch):
    """Whatever else draws from NumPy's generator, which is left as it was."""
    pytest.importorskip("cma")

    def losses(problems, thetas):
        np.random.standard_normal(3)  # another search
        return jnp.sum((thetas - 0.3) ** 2, axis=1)

    monkeypatch.setattr(methods, "_losses", losses)

    def tried(seed):
        return methods.cma_es((problem,), 30, key=jr.key(seed)).history

    np.random.seed(7)
    first = tried(0)
    after = np.random.standard_normal()
    np.random.seed(7)
    np.random.standard_normal((len(first), 3))
    assert after == np.random.standard_normal()
    np.testing.assert_array_equal(first, tried(0))
    assert not np.array_equal(first, tried(1))


def test_a_descent_does_not_go_where_its_derivative_is_not_finite(problem):
    """However low the loss is there: it could neither go on, nor say how well that is known."""
    (start,) = row_of(problem, [1e-6])
    start = dataclasses.replace(start, damping=jnp.asarray(0.1), growth=jnp.asarray(2.0))
    lower = dataclasses.replace(start.normal, loss=jnp.asarray(5e-7))
    lost = dataclasses.replace(lower, scatter=lower.scatter.at[0, 0].set(jnp.nan))
    for tried, is_taken in ((lower, True), (lost, False)):
        after = gauss_newton.accept((problem,), start, start.theta + 0.1, tried, 0.0)
        assert (after.theta[0] > start.theta[0]) == is_taken
        assert (after.damping < start.damping) == is_taken


@pytest.mark.slow(group="estimates")
def test_without_a_derivative_an_estimate_is_not_sure_and_knows_what_was_known(problem):
    def without(problems, theta, width=None):
        found = derivatives_at(problems, theta, width)
        return [(seen, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), s)) for seen, s in found]

    budget = Budget(num_samples=0, num_starts=1, num_probes=0, max_iterations=3)
    run = Run(budget, jr.key(0), without)
    estimate = with_uncertainty(descent.multi_start((problem,), run), run)
    assert not estimate.converged and estimate.unsure == NO_DERIVATIVE
    _, precision = problem.space.prior()
    widths = np.array([each.width for each in problem.space.ranges])
    known = np.sqrt(np.diag(np.linalg.inv(np.asarray(precision)))) * widths
    np.testing.assert_allclose(estimate.standard_errors, known, rtol=1e-5)


def test_without_a_derivative_the_error_of_a_mesh_is_added_and_nothing_is_solved(problem):
    space = OrthotropicSpace.make(0.2)
    known = dataclasses.replace(problem, space=prior.informed(space, 0.2))
    size = theta_length((known,))
    (end,) = row_of(known, [1e-6])
    lost = dataclasses.replace(end.normal, matrix=jnp.full((size, size), jnp.nan))
    end = dataclasses.replace(end, normal=lost)
    error, other = (np.full(size, 0.1), np.eye(size)), OtherMesh((known,), 4 / 3)
    theta, covariance, _ = standard_errors.with_mesh_error(
        (known,), other, end, jnp.asarray(jnp.nan), np.eye(size), error
    )
    np.testing.assert_allclose(covariance, 2 * np.eye(size), rtol=1e-6)
    np.testing.assert_array_equal(theta, end.theta)
