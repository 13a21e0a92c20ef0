"""A run that fails says which part failed first, and when, in sweeps too."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from conftest import DT, cloth, flat

from r2s.environment.scene import Control
from r2s.solvers.results import Result, describe, first_failure
from r2s.solvers.simulate import simulate

FRAMES, STEPS = 3, 2
STILL = Control(jnp.zeros((FRAMES * STEPS, 0, 3)))
NONE = Result.SUCCESS.value


@eqx.filter_jit
def run(solver, fabric, x, control=STILL):
    return simulate(solver, fabric, solver.init(x), control, save_every=STEPS)


def crumpled(sheet):
    """A sheet far from rest, so that one iteration of Newton's method cannot suffice."""
    return flat(sheet) + 0.02 * jax.random.normal(jax.random.key(0), (len(sheet.rest), 3))


@pytest.mark.slow(group="cloth")
def test_a_run_that_goes_well_has_no_failure(sheet, fabric):
    moved = run(cloth(sheet), fabric, flat(sheet))
    assert bool(jnp.all(moved.ok)) and moved.explain() == ""
    assert int(moved.result) == NONE and bool(jnp.isnan(moved.failed_at))


@pytest.mark.slow(group="cloth")
def test_newton_that_is_cut_short_is_named_with_its_time(sheet, fabric):
    solver = dataclasses.replace(cloth(sheet), max_iterations=1)
    moved = run(solver, fabric, crumpled(sheet))
    assert moved.result == Result.NEWTON.value and not bool(jnp.any(moved.ok))
    assert float(moved.failed_at) == pytest.approx(DT)
    assert moved.explain().startswith("failed at 0.01 s: Newton")
    assert bool(jnp.all(jnp.isnan(moved.x)))


@pytest.mark.slow(group="cloth")
def test_the_time_is_that_of_the_step_that_failed(sheet, fabric):
    # the wind is not a number from the second step of the second frame on
    wind = jnp.zeros((FRAMES * STEPS, 3)).at[3:].set(jnp.nan)
    air = cloth(sheet, air=1.2)
    moved = run(air, fabric, flat(sheet), Control(STILL.pinned, wind))
    assert moved.result == Result.NON_FINITE.value
    assert float(moved.failed_at) == pytest.approx(4 * DT)
    assert moved.ok.tolist() == [True, False, False]


@pytest.mark.slow(group="cloth")
def test_a_matrix_that_is_not_definite_is_named(sheet, fabric):
    lighter_than_nothing = dataclasses.replace(fabric, density=-fabric.density)
    moved = run(cloth(sheet), lighter_than_nothing, crumpled(sheet))
    assert moved.result == Result.LINEAR_SOLVE.value


@pytest.mark.slow(group="cloth")
def test_in_a_sweep_each_member_has_its_own(sheet, fabric):
    solver, x = cloth(sheet), flat(sheet)

    def weighing(density):
        return run(solver, dataclasses.replace(fabric, density=density), x)

    moved = jax.vmap(weighing)(jnp.array([1.0, jnp.nan, 1.0]) * fabric.density)
    assert moved.result.tolist() == [NONE, Result.NON_FINITE.value, NONE]
    assert jnp.isfinite(moved.failed_at).tolist() == [False, True, False]
    with pytest.raises(ValueError, match="a batch of shape"):
        moved.explain()


def test_the_first_failure_stays():
    none, newton, grid = (
        jnp.asarray(f.value) for f in (Result.SUCCESS, Result.NEWTON, Result.GRID)
    )
    assert first_failure(none, newton) == newton and first_failure(newton, grid) == newton
    assert first_failure(newton, none) == newton and first_failure(none, none) == none


def test_every_failure_is_described_and_another_number_is_refused():
    sentences = [describe(code) for code in Result]
    assert len(set(sentences)) == len(Result)
    with pytest.raises(ValueError):
        describe(99)
