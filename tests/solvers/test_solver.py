"""Rollouts: what they keep, how much memory that takes, and how many steps they make."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat

from r2s.environment.scene import Control
from r2s.mesh.mesh import rectangle
from r2s.scenarios.scenario import MAX_STEP, steps_between
from r2s.solvers.simulate import predicted_memory, simulate


@pytest.fixture(scope="module")
def loss(sheet, fabric):
    """A function of a fabric for a number of frames, and whether solutions are kept."""
    solver = cloth(sheet, pinned=(0,), air=1.2)
    start = solver.init(flat(sheet))

    def make(frames, keep):
        control, how = Control(jnp.zeros((2 * frames, 1, 3))), {"keep_solutions": keep}
        return lambda fabric: jnp.sum(
            simulate(solver, fabric, start, control, save_every=2, **how).x[-1] ** 2
        )

    return make


@pytest.mark.slow(group="cloth")
def test_what_is_kept_does_not_change_the_gradient(loss, fabric):
    kept, solved = (eqx.filter_jit(jax.grad(loss(3, keep)))(fabric) for keep in (True, False))
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(solved), strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b), rel=1e-9, abs=1e-15)


@pytest.mark.slow(group="cloth")
def test_only_the_frames_that_are_wanted_are_simulated(sheet, fabric):
    solver = cloth(sheet, pinned=(0,), air=1.2)
    control = Control(jnp.zeros((10, 1, 3)))
    broken = Control(control.pinned.at[6:].set(jnp.nan))

    @eqx.filter_jit
    def moved(fabric, control, saves):
        def x(fabric):
            start = solver.init(flat(sheet))
            found = simulate(solver, fabric, start, control, save_every=2, saves=saves)
            return found.x, found

        slope, found = jax.jacfwd(x, has_aux=True)(fabric)
        return found, slope

    whole, slope = moved(fabric, control, jnp.asarray(5))
    first, early = moved(fabric, broken, jnp.asarray(3))
    np.testing.assert_array_equal(first.x[:3], whole.x[:3])
    assert bool(first.ok.all()) and int(first.result) == 0
    for here, there in zip(jax.tree.leaves(early), jax.tree.leaves(slope), strict=True):
        np.testing.assert_array_equal(here[:3], there[:3])
        np.testing.assert_array_equal(here[3:], np.stack([here[2]] * 2))
    assert not bool(moved(fabric, broken, jnp.asarray(4))[0].ok.all())


@pytest.mark.slow(group="cloth")
def test_memory_is_predicted_without_a_run(loss, fabric):
    short, long = (predicted_memory(jax.grad(loss(frames, True)), fabric) for frames in (3, 43))
    # 40 frames more: four arrays of the state, and the solutions of two steps, 25 x 3 float64 each
    assert 40 * 6 * 25 * 3 * 8 <= long - short < 3 * 40 * 6 * 25 * 3 * 8


@pytest.mark.parametrize(
    ("speed", "expected"),
    [(0.0, 3), (0.5, 3), (4.0, 6)],  # frames of 1/15 s, cells of 50 mm
)
def test_steps_follow_the_fastest_gripper(speed, expected):
    mesh = rectangle((0.2, 0.2), (5, 5))
    path = np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, speed]]])
    found = steps_between(1 / 15, mesh, path, np.array([0.0, 1.0]))
    assert found == expected
    assert 1 / 15 / found <= min(MAX_STEP, 0.05 / max(speed, 1e-9)) + 1e-12
