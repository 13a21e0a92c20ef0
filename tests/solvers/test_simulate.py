"""Motions: what they save, what they keep for gradients, and which part failed first, and when."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DT, cloth, flat

from r2s.environment.scene import Control
from r2s.mesh.mesh import rectangle
from r2s.recordings.recording import MAX_STEP
from r2s.scenarios.scenario import steps_between
from r2s.solvers.results import Result, describe, first_failure
from r2s.solvers.simulate import predicted_memory, simulate

FRAMES, STEPS = 3, 2
STILL = Control(jnp.zeros((FRAMES * STEPS, 0, 3)))


@eqx.filter_jit
def run(solver, fabric, x, control=STILL):
    return simulate(solver, fabric, solver.init(x), control, save_every=STEPS)


def crumpled(sheet):
    """A sheet far from rest, so that one iteration of Newton's method cannot suffice."""
    return flat(sheet) + 0.02 * jax.random.normal(jax.random.key(0), (len(sheet.rest), 3))


@pytest.mark.slow(group="cloth")
def test_what_fails_is_named_with_its_time(sheet, fabric):
    moved = run(cloth(sheet), fabric, flat(sheet))
    assert bool(jnp.all(moved.ok)) and moved.explain() == ""
    assert int(moved.result) == Result.SUCCESS and bool(jnp.isnan(moved.failed_at))
    moved = run(dataclasses.replace(cloth(sheet), max_iterations=1), fabric, crumpled(sheet))
    assert moved.result == Result.NEWTON and not bool(jnp.any(moved.ok))
    assert float(moved.failed_at) == pytest.approx(DT)
    assert moved.explain().startswith("failed at 0.01 s: Newton")
    assert bool(jnp.all(jnp.isnan(moved.x)))
    negative = dataclasses.replace(fabric, density=-fabric.density)
    assert run(cloth(sheet), negative, crumpled(sheet)).result == Result.LINEAR_SOLVE
    # the wind is not a number from the second step of the second frame on
    wind = jnp.zeros((FRAMES * STEPS, 3)).at[3:].set(jnp.nan)
    moved = run(cloth(sheet, air=1.2), fabric, flat(sheet), Control(STILL.pinned, wind))
    assert moved.result == Result.NON_FINITE and moved.ok.tolist() == [True, False, False]
    assert float(moved.failed_at) == pytest.approx(4 * DT)


@pytest.mark.slow(group="cloth")
def test_in_a_batch_each_member_has_its_own_failure(sheet, fabric):
    def weighing(density):
        return run(cloth(sheet), dataclasses.replace(fabric, density=density), flat(sheet))

    moved = jax.vmap(weighing)(jnp.array([1.0, jnp.nan, 1.0]) * fabric.density)
    assert moved.result.tolist() == [Result.SUCCESS, Result.NON_FINITE, Result.SUCCESS]
    assert jnp.isfinite(moved.failed_at).tolist() == [False, True, False]
    with pytest.raises(ValueError, match="a batch of shape"):
        moved.explain()


def test_the_first_failure_stays_and_each_is_described():
    none, newton, grid = (jnp.asarray(code.value) for code in (Result(0), Result(1), Result(4)))
    assert first_failure(none, newton) == newton and first_failure(newton, grid) == newton
    assert first_failure(newton, none) == newton and first_failure(none, none) == none
    assert len({describe(code) for code in Result}) == len(Result)
    with pytest.raises(ValueError):
        describe(99)


@pytest.fixture(scope="module")
def loss(sheet, fabric):
    """A function of a fabric for a number of frames, and whether solutions are kept."""
    solver = cloth(sheet, pinned=(0,), air=1.2)
    start = solver.init(flat(sheet))

    def make(frames, keep):
        control, options = Control(jnp.zeros((2 * frames, 1, 3))), {"keep_solutions": keep}
        return lambda fabric: jnp.sum(
            simulate(solver, fabric, start, control, save_every=2, **options).x[-1] ** 2
        )

    return make


@pytest.mark.slow(group="cloth")
def test_what_is_kept_takes_memory_and_does_not_change_the_gradient(loss, fabric):
    kept, solved = (eqx.filter_jit(jax.grad(loss(3, keep)))(fabric) for keep in (True, False))
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(solved), strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b), rel=1e-9, abs=1e-15)
    short, long = (predicted_memory(jax.grad(loss(frames, True)), fabric) for frames in (3, 43))
    # 40 frames more: four arrays of the state, and the solutions of two steps, 25 x 3 float64 each
    assert 40 * 6 * 25 * 3 * 8 <= long - short < 3 * 40 * 6 * 25 * 3 * 8


@pytest.mark.slow(group="cloth")
def test_only_the_frames_that_are_wanted_are_simulated(sheet, fabric):
    solver = cloth(sheet, pinned=(0,), air=1.2)
    control = Control(jnp.zeros((10, 1, 3)))
    broken = Control(control.pinned.at[6:].set(jnp.nan))

    @eqx.filter_jit
    def moved(fabric, control, saves):
        def x(fabric):
            start = solver.init(flat(sheet))
            solution = simulate(solver, fabric, start, control, save_every=2, saves=saves)
            return solution.x, solution

        return jax.jacfwd(x, has_aux=True)(fabric)

    slope, whole = moved(fabric, control, jnp.asarray(5))
    early, first = moved(fabric, broken, jnp.asarray(3))
    np.testing.assert_array_equal(first.x[:3], whole.x[:3])
    assert bool(first.ok.all()) and int(first.result) == 0
    for cut, full in zip(jax.tree.leaves(early), jax.tree.leaves(slope), strict=True):
        np.testing.assert_array_equal(cut[:3], full[:3])
        np.testing.assert_array_equal(cut[3:], np.stack([cut[2]] * 2))
    assert not bool(moved(fabric, broken, jnp.asarray(4))[1].ok.all())


@pytest.mark.parametrize(
    ("speed", "expected"),
    [(0.0, 3), (0.5, 3), (4.0, 6)],  # frames of 1/15 s, cells of 50 mm
)
def test_steps_follow_the_fastest_gripper(speed, expected):
    mesh = rectangle((0.2, 0.2), (5, 5))
    path = np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, speed]]])
    count = steps_between(1 / 15, mesh, path, np.array([0.0, 1.0]))
    assert count == expected
    assert 1 / 15 / count <= min(MAX_STEP, 0.05 / max(speed, 1e-9)) + 1e-12
