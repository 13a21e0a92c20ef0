"""Recordings of two fabrics in one estimate contradict each other, and the odd one is named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from r2s import scenarios
from r2s.estimation.consistency import (
    MOST,
    UNLIKELY,
    Information,
    agreement,
    density_of,
    information_of,
    outlier,
    scatter_of,
)
from r2s.estimation.descent import DEFAULT
from r2s.estimation.estimate import Agreement
from r2s.estimation.gauss_newton import theta_length
from r2s.estimation.judgement import each_alone
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
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
    return agreement(problems, ends)


@pytest.mark.slow(group="estimates")
def test_recordings_of_one_fabric_agree(lifts):
    first, second, _, place = lifts
    assert judged((first,), place) is None
    found = judged((first, second), place)
    assert found is not None and found.contradiction is None and min(found.told) > 2


@pytest.mark.slow(group="estimates")
def test_the_recording_of_another_fabric_is_named(lifts):
    first, second, other, place = lifts
    found = judged((first, other, second), place)
    assert found is not None and found.p < 1e-6
    odd = found.contradiction
    assert odd is not None and odd.recording == 1
    assert odd.parameter in ("warp", "weft", "shear") and odd.errors > 3
    assert odd.values[0] == pytest.approx(3 * odd.values[1], rel=0.3)
    pair = judged((first, other), place)
    assert pair is not None and pair.p < 1e-6


@pytest.mark.slow(group="estimates")
def test_a_recording_is_excused_by_the_error_of_its_own_mesh_alone(lifts):
    """As far as its mesh leads astray, and whatever the signs: those are not told."""
    first, _, other, place = lifts
    pair = first, other
    ends = each_alone(pair, DEFAULT, _theta(pair, place), jax.random.key(0))
    none, far = np.zeros(len(place)), np.full(len(place), MOST)
    alone, _, excused, opposite, hardly = (
        agreement(pair, ends, biases)
        for biases in (
            (),
            [none, none],
            [none, far],
            [none, -far * (-1) ** np.arange(len(place))],
            [none, far / 100],
        )
    )
    assert alone is not None and excused is not None and opposite is not None
    assert excused.p == opposite.p > alone.p == excused.exact and alone.exact is None
    # three times as stiff is no more than two meshes of the worst may do, and that is said
    both = agreement(pair, ends, [far, far])
    assert both is not None and both.contradiction is None
    assert both.exact == alone.p < UNLIKELY < both.p
    assert hardly is not None and hardly.contradiction is not None


def _linear(rng, seen, place, precision, shift=0.0):
    """The estimate of a linear recording of some numbers, the first of which is off by a shift."""
    looks = rng.normal(scale=30.0, size=(seen, len(place)))
    saw = looks @ place + rng.normal(size=seen)
    saw[0] += shift
    covariance = np.linalg.inv(looks.T @ looks + precision)
    return covariance @ (looks.T @ saw + precision @ np.full(len(place), 0.5)), covariance


def _chances(shift, count=400, dim=12):
    """Of four recordings that tell four directions each, how likely they lead so far apart."""
    rng, precision, mean = np.random.default_rng(0), 12 * np.eye(dim), np.full(dim, 0.5)
    found = []
    for _ in range(count):
        place = mean + 0.2 * rng.normal(size=dim)
        ends = [_linear(rng, 4, place, precision, shift * (i == 1)) for i in range(4)]
        found.append(
            stats.chi2.sf(*scatter_of([information_of(*end, mean, precision) for end in ends]))
        )
    return np.array(found)


def test_recordings_of_one_fabric_scatter_as_the_test_says_whatever_they_do_not_tell():
    chances = _chances(0.0)
    for level in (0.1, 0.5):
        assert np.mean(chances < level) == pytest.approx(level, abs=0.06)
    assert np.mean(chances < 0.01) < 0.03


def test_one_that_is_off_by_ten_standard_errors_is_mostly_found():
    assert np.mean(_chances(10.0) < 1e-4) > 0.4
    assert np.mean(_chances(20.0) < 1e-4) > 0.8


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_the_density_that_was_given_wrongly_is_found(ratio):
    """A pull tells three stiffnesses, a lift the same over the density, and one number more."""
    rng, precision, mean = np.random.default_rng(1), 12 * np.eye(4), np.full(4, 0.5)
    scaled, place = np.array([0.12, 0.12, 0.15, 0.0]), np.array([0.4, 0.5, 0.6, 0.3])
    pull, lift = np.diag([1e4, 1e4, 1e4, 0.0]), np.diag([1e3, 1e3, 1e3, 1e3])
    told = []
    for information, there in ((pull, place), (lift, place + np.log(ratio) * scaled)):
        noise = np.sqrt(information) @ rng.normal(size=4)
        covariance = np.linalg.inv(information + precision)
        end = covariance @ (information @ there + noise + precision @ mean)
        told.append(information_of(end, covariance, mean, precision))
    density, error = density_of(told, [True, False], scaled, mean, precision)
    assert np.log(density * ratio) == pytest.approx(0, abs=3 * error) and error < 0.3
    found = Agreement(1.0, (3, 4), None, (density, error))
    assert found.doubts_density == (ratio != 1)


def test_what_an_estimate_kept_of_its_prior_is_not_told_by_its_recording():
    mean, precision = np.array([0.5, 0.5]), np.diag([12.0, 12.0])
    covariance = np.linalg.inv(precision + np.diag([1e4, 1.0]))
    place = mean + covariance @ np.array([1e4 * 0.1, 1.0 * 0.3])
    told = information_of(place, covariance, mean, precision)
    assert told.count == 1
    np.testing.assert_allclose(told.information, np.diag([1e4, 0]), atol=1e-6)
    np.testing.assert_allclose(told.place, [0.6, 0.5], atol=1e-9)


def _told(*known):
    """What a recording tells of a warp and a weft: where to, and how precisely."""
    place = np.array([each[0] if each else 0.0 for each in known])
    information = np.diag([1 / each[1] ** 2 if each else 0.0 for each in known])
    return Information(place, information, sum(bool(each) for each in known))


def test_the_odd_recording_is_the_one_that_adds_what_is_least_likely():
    """Not the one without which there is nothing left to compare."""
    lift, weft = _told((0.5, 0.01), (0.5, 0.01)), _told((), (0.514, 0.01))
    wrong = _told((0.6, 0.01), ())
    assert outlier([lift, wrong, weft]) == 1
    assert outlier([wrong, weft, lift]) == 0
    tells_nothing = _told((), ())
    assert outlier([tells_nothing, lift, wrong]) == 2  # of two that contradict, the second
    assert outlier([lift, wrong]) == 1
    both_against_it = _told((0.7, 0.01), (0.7, 0.01))
    assert outlier([both_against_it, _told((0.5, 0.01), ()), weft]) == 0
    # however far it is: two chances may both be less than the least number
    far = _told((1.5, 0.01), (0.5, 0.01))
    assert outlier([lift, far, _told((0.51, 0.01), (0.5, 0.01))]) == 1
