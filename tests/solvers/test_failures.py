"""A run that fails says which part failed first, in which frame and step, in sweeps too."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from conftest import cloth, flat

from r2s.environment.scene import Control
from r2s.solvers.failures import Failure, describe, first_failure
from r2s.solvers.simulate import simulate

FRAMES, STEPS = 3, 2
STILL = Control(jnp.zeros((FRAMES, STEPS, 0, 3)), jnp.zeros((FRAMES, STEPS, 3)))
NONE = Failure.NONE.value


@eqx.filter_jit
def run(solver, fabric, x, controls=STILL):
    return simulate(solver, fabric, solver.init(x), controls)


def crumpled(sheet):
    """A sheet far from rest, so that one iteration of Newton's method cannot suffice."""
    return flat(sheet) + 0.02 * jax.random.normal(jax.random.key(0), (len(sheet.rest), 3))


@pytest.mark.slow(group="cloth")
def test_a_run_that_goes_well_has_no_failure(sheet, fabric):
    moved = run(cloth(sheet), fabric, flat(sheet))
    assert bool(jnp.all(moved.ok)) and moved.explain() == ""
    assert [int(n) for n in (moved.failure, moved.failed_frame, moved.failed_step)] == [
        NONE,
        -1,
        -1,
    ]


@pytest.mark.slow(group="cloth")
def test_newton_that_is_cut_short_is_named_with_frame_and_step(sheet, fabric):
    solver = dataclasses.replace(cloth(sheet), max_iterations=1)
    moved = run(solver, fabric, crumpled(sheet))
    assert moved.failure == Failure.NEWTON.value and not bool(jnp.any(moved.ok))
    assert (int(moved.failed_frame), int(moved.failed_step)) == (0, 0)
    assert "frame 0, step 0" in moved.explain() and "Newton" in moved.explain()
    assert bool(jnp.all(jnp.isnan(moved.x)))


@pytest.mark.slow(group="cloth")
def test_the_frame_and_step_are_those_in_which_it_failed(sheet, fabric):
    # the wind is not a number from the second step of the second frame on
    wind = STILL.wind.at[1, 1:].set(jnp.nan).at[2].set(jnp.nan)
    air = cloth(sheet, air=1.2)
    moved = run(air, fabric, flat(sheet), Control(STILL.handles, wind))
    assert moved.failure == Failure.NON_FINITE.value
    assert (int(moved.failed_frame), int(moved.failed_step)) == (1, 1)
    assert moved.ok.tolist() == [True, False, False]
    later = moved.from_frame(2)
    assert int(later.failed_frame) == -1 and "1 frames before the first one" in later.explain()


@pytest.mark.slow(group="cloth")
def test_a_matrix_that_is_not_definite_is_named(sheet, fabric):
    lighter_than_nothing = dataclasses.replace(fabric, density=-fabric.density)
    moved = run(cloth(sheet), lighter_than_nothing, crumpled(sheet))
    assert moved.failure == Failure.LINEAR_SOLVE.value


@pytest.mark.slow(group="cloth")
def test_in_a_sweep_each_member_has_its_own(sheet, fabric):
    solver, x = cloth(sheet), flat(sheet)

    def weighing(density):
        return run(solver, dataclasses.replace(fabric, density=density), x)

    moved = jax.vmap(weighing)(jnp.array([1.0, jnp.nan, 1.0]) * fabric.density)
    assert moved.failure.tolist() == [NONE, Failure.NON_FINITE.value, NONE]
    assert moved.failed_frame.tolist() == [-1, 0, -1]
    with pytest.raises(ValueError, match="a batch of shape"):
        moved.explain()


def test_the_first_failure_stays():
    none, newton, grid = (
        jnp.asarray(f.value) for f in (Failure.NONE, Failure.NEWTON, Failure.GRID)
    )
    assert first_failure(none, newton) == newton and first_failure(newton, grid) == newton
    assert first_failure(newton, none) == newton and first_failure(none, none) == none


def test_every_failure_is_described_and_another_number_is_refused():
    sentences = [describe(code) for code in Failure]
    assert len(set(sentences)) == len(Failure)
    with pytest.raises(ValueError):
        describe(99)
