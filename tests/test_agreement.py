"""Recordings of two fabrics in one estimate contradict each other, and the odd one is named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation.agreement import contradiction
from r2s.estimation.descent import DEFAULT, each_alone
from r2s.estimation.gauss_newton import theta_length
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

SHAPE = (5, 5)


def stiffer(fabric, times):
    membrane = jax.tree.map(lambda c: times * c, fabric.membrane)
    return dataclasses.replace(fabric, membrane=membrane)


@pytest.fixture(scope="module")
def lifts():
    """Two lifts of a knit, and one of a knit thrice as stiff of the same weight."""
    knit = presets.grey_interlock()
    space = OrthotropicSpace.make(float(knit.density))
    experiment = scenarios.lifting(num_frames=16, interval=0.18)
    exact = NuisancePrior(0.0, 0.0)

    def lift(fabric, seed):
        seen = synthetic.record(experiment, fabric, "lift", shape=SHAPE, key=jax.random.key(seed))
        return Problem.make(seen, space, shape=SHAPE, nuisance_prior=exact)

    return lift(knit, 0), lift(knit, 1), lift(stiffer(knit, 3.0), 2), space.to_unit(knit)


def _theta(problems, place):
    return jnp.zeros(theta_length(problems), float).at[: len(place)].set(place)


def judged(problems, place):
    ends = each_alone(problems, DEFAULT, _theta(problems, place), jax.random.key(0))
    return contradiction(problems, ends)


@pytest.mark.slow(group="estimates")
def test_recordings_of_one_fabric_agree(lifts):
    first, second, _, place = lifts
    assert judged((first,), place) is None
    assert judged((first, second), place) is None


@pytest.mark.slow(group="estimates")
def test_the_recording_of_another_fabric_is_named(lifts):
    first, second, other, place = lifts
    found = judged((first, other, second), place)
    assert found is not None and found.recording == 1 and found.p < 1e-6
    assert found.parameter in ("warp", "weft", "shear") and found.errors > 3
    pair = judged((first, other), place)
    assert pair is not None and pair.p < 1e-6


@pytest.mark.slow(group="estimates")
def test_a_recording_is_excused_by_the_error_of_its_own_mesh_alone(lifts):
    """As far as its mesh leads astray, and whatever the signs: those are not told."""
    first, _, other, place = lifts
    ends = each_alone((first, other), DEFAULT, _theta((first, other), place), jax.random.key(0))
    none, far = np.zeros(len(place)), np.full(len(place), 0.5)
    assert contradiction((first, other), ends, [none, far]) is None
    assert contradiction((first, other), ends, [none, -far * (-1) ** np.arange(len(place))]) is None
    assert contradiction((first, other), ends, [none, far / 100]) is not None
