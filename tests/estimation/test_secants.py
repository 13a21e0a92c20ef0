"""Derivatives by secants, without simulating."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import problem

from r2s.estimation.prediction import (
    Prediction,
    Sensitivity,
    secant,
    theta_length,
)

PROBLEM = problem(1.0)
SIZE, DIM = theta_length((PROBLEM,)), PROBLEM.space.dim


def linear(shape=(3, 4, 3)):
    """A prediction with random slopes, and another that they do not explain."""
    shapes = shape, (*shape, SIZE), shape
    keys = jr.split(jr.key(0), len(shapes))
    x, slope, new = (jr.normal(*each) for each in zip(keys, shapes, strict=True))
    yes = jnp.array(True)
    return Prediction(x, None, yes), Sensitivity(slope, None), Prediction(new, None, yes)


def test_a_secant_explains_its_motion_and_changes_nothing_across_it():
    old, slope, new = linear()
    change = jnp.zeros(SIZE).at[:DIM].set(0.1).at[-1].set(0.3)
    (after,) = secant((PROBLEM,), [(old, slope)], [new], change)
    np.testing.assert_allclose(after.x @ change, new.x - old.x, atol=1e-5)
    across = jnp.zeros(SIZE).at[0].set(1.0).at[1].set(-1.0)
    np.testing.assert_allclose(after.x @ across, slope.x @ across, atol=1e-5)
    # what cameras see of a motion is not the motion's
    np.testing.assert_array_equal(after.x[..., -1], slope.x[..., -1])


@pytest.mark.parametrize("cause", ["diverged", "no step"])
def test_nothing_is_learnt_from_a_motion_that_diverged_nor_from_none(cause):
    old, slope, new = linear()
    change = jnp.zeros(SIZE).at[0].set(0.1)
    if cause == "diverged":
        new = Prediction(new.x * jnp.nan, None, jnp.array(False))
    else:
        change = jnp.zeros(SIZE)
    (after,) = secant((PROBLEM,), [(old, slope)], [new], change)
    np.testing.assert_array_equal(after.x, slope.x)
