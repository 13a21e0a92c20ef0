"""What an estimate does not know for sure: the air, and what a rough loss leaves open."""

import dataclasses

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import FABRIC, FAMILY, short_problem

from r2s import scenarios
from r2s.estimation import gauss_newton, methods
from r2s.estimation.judgement import descend
from r2s.estimation.prediction import free_nuisances, nuisances, predict, theta_length
from r2s.estimation.problem import NuisancePrior, Problem, default_nuisance_prior
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.recording import MeasurementUncertainty
from r2s.scenarios import synthetic

RATIO = 1.2


@pytest.fixture(scope="module")
def blown():
    """A sheet in wind, of few frames and vertices."""
    experiment = scenarios.wind(num_frames=6, interval=1 / 10)
    record = synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))
    return Problem.make(record, FAMILY, num_points=60, shape=(4, 4))


@pytest.fixture(scope="module")
def lifted():
    return short_problem()


@pytest.mark.slow(group="estimates")
def test_heavier_stiffer_and_in_denser_air_a_sheet_moves_alike(blown):
    """All forces and the mass by one factor: without it known, wind cannot tell the three apart."""
    problem = dataclasses.replace(blown, nuisance_prior=NuisancePrior(density=0.5, air=0.5))
    place, change = FAMILY.to_unit(FABRIC), np.log(RATIO)
    wider = [
        change / np.log(b.high / b.low) if b.name in ("warp", "weft", "shear", "bending") else 0.0
        for b in FAMILY.ranges
    ]
    seen = jax.jit(lambda u: predict(problem, u).x)

    def at(place, *ratios):
        return seen(jnp.concatenate([place, jnp.array(ratios), jnp.zeros(6)]))

    plain, scaled = at(place, 0.0, 0.0), at(place + jnp.array(wider), *(change / 0.5,) * 2)
    heavier = at(place + jnp.array(wider), change / 0.5, 0.0)
    np.testing.assert_allclose(scaled, plain, atol=1e-6)
    assert float(jnp.max(jnp.abs(heavier - plain))) > 5e-3


@pytest.mark.slow(group="estimates")
def test_the_air_is_in_doubt_where_a_wind_blows(blown, lifted):
    assert (
        blown.nuisance_prior == NuisancePrior(air=0.1) and lifted.nuisance_prior == NuisancePrior()
    )
    theta = np.arange(20.0)
    shifts = ["shift x", "shift y", "shift z", "turn"]
    first, second = ([f"{name} {number}" for name in shifts] for number in (1, 2))
    for problems, names in (
        ((blown,), ["air ratio", *shifts]),
        ((lifted, blown), [*first, "air ratio", *second]),
        ((blown, blown), ["air ratio", *first, *second]),
    ):
        assert [each.name for each in nuisances(problems, theta, theta)] == names
    (air, *_) = nuisances((blown,), theta, theta)
    assert air.value == pytest.approx(np.exp(0.1 * 8)) and air.unit == "-"


@pytest.mark.slow(group="estimates")
def test_wind_gives_the_stiffness_of_a_sheet_that_was_weighed_wrongly():
    """By 4 %: all is found as if it were so much stiffer, and the air so much stronger."""
    denim = presets.black_denim()
    record = synthetic.record(scenarios.wind(), denim, "denim", key=jr.key(0))
    wrong = 1.04
    space = OrthotropicSpace.make(wrong * float(denim.density))
    found = descend(Problem.make(record, space), key=jr.key(0))
    truth = np.asarray(space.values(space.to_unit(denim)))
    stiff = [i for i, b in enumerate(space.ranges) if b.name in ("warp", "weft", "shear")]
    ratio = found.values[stiff] / truth[stiff]
    np.testing.assert_allclose(ratio, wrong, atol=0.05)
    assert np.all(np.abs(np.log(ratio / wrong)) < 3 * found.standard_errors[stiff])
    air = found.nuisances[0]
    assert air.name == "air ratio" and air.value == pytest.approx(wrong, rel=5e-3)


def test_the_air_of_a_recording_is_in_doubt_where_it_says_so(blown, lifted):
    here, nowhere = (0.0, 0.0, 0.0), 0.0
    still, windy = lifted.scenario, blown.scenario
    assert default_nuisance_prior(still).air == 0
    assert default_nuisance_prior(still, MeasurementUncertainty(here, nowhere, air=0.5)).air == 0.5
    assert (
        default_nuisance_prior(windy, MeasurementUncertainty(here, nowhere)).air
        == default_nuisance_prior(windy).air
    )
    with pytest.raises(ValueError, match="negative"):
        MeasurementUncertainty(here, nowhere, air=-1.0)


@pytest.mark.slow(group="estimates")
def test_cma_es_tells_the_nuisances_with_which_it_has_its_loss(lifted):
    pytest.importorskip("cma")
    found = methods.cma_es((lifted,), 40, key=jr.key(0))
    free = list(free_nuisances((lifted,)))
    assert [each.name for each in found.nuisances] == [each.name for each in free] != []
    theta = np.zeros(theta_length((lifted,)))
    theta[: lifted.space.dim] = lifted.space.to_unit(found.fabric)
    for each, told in zip(free, found.nuisances, strict=True):
        assert np.isnan(told.standard_error)
        theta[each.place] = told.value / each.scale
    loss = float(gauss_newton.loss_at((lifted,), jnp.asarray(theta, float)))
    assert found.loss == pytest.approx(loss, rel=1e-3)
    assert np.abs(theta[lifted.space.dim :]).max() > 0.1
