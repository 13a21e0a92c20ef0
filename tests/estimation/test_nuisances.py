"""What an estimate does not know for sure: the air, and what a rough loss leaves open."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation import cma_es, compiled, gauss_newton
from r2s.estimation.consistency import weighing
from r2s.estimation.estimate import describe
from r2s.estimation.gauss_newton import Descent, Normal
from r2s.estimation.judgement import descend
from r2s.estimation.mesh_bias import (
    MeshError,
    OtherMesh,
    _positive,
    _posterior,
    coarser_of,
    factor,
    settled,
)
from r2s.estimation.method import Budget
from r2s.estimation.prediction import free as nuisances_that_vary
from r2s.estimation.prediction import nuisances, predict
from r2s.estimation.problem import (
    Force,
    NuisancePrior,
    Problem,
    default_nuisance_prior,
)
from r2s.estimation.standard_errors import (
    FARTHEST,
    covariance,
    covariance_at,
    sample_around,
    steps_apart,
)
from r2s.materials import presets
from r2s.materials.informed_space import InformedSpace
from r2s.materials.parameters import UNIFORM_DEVIATION, OrthotropicSpace
from r2s.recordings.recording import Doubt
from r2s.scenarios import synthetic

FABRIC = presets.grey_interlock()
FAMILY = OrthotropicSpace.make(float(FABRIC.density))
RATIO = 1.2


@pytest.fixture(scope="module")
def blown():
    """A sheet in wind, of few frames and vertices."""
    experiment = scenarios.wind(num_frames=6, interval=1 / 10)
    record = synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))
    return Problem.make(record, FAMILY, num_points=60, shape=(4, 4))


def lift(num_frames: int) -> Problem:
    """Of a sheet of few vertices; the second half of the frames counts."""
    experiment = scenarios.lifting(num_frames=num_frames, interval=1 / 10, height=0.2, moving=0.3)
    record = synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))
    return Problem.make(record, FAMILY, num_points=60, shape=(4, 4))


@pytest.fixture(scope="module")
def lifted():
    return lift(4)


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

    def names(*problems):
        return [c.name for c in nuisances(problems, theta, theta)]

    shifts = ["shift x", "shift y", "shift z", "turn"]

    def numbered(number):
        return [f"{name} {number}" for name in shifts]

    assert names(blown) == ["air ratio", *shifts]
    assert names(lifted, blown) == [*numbered(1), "air ratio", *numbered(2)]
    assert names(blown, blown) == ["air ratio", *numbered(1), *numbered(2)]
    (air, *_) = nuisances((blown,), theta, theta)
    assert air.value == pytest.approx(np.exp(0.1 * 8)) and air.unit == "-"


def test_the_prior_of_theta_holds_what_is_known_of_the_fabric(lifted):
    dim = lifted.space.dim
    precision = np.diag(np.arange(1.0, dim + 1)) + 0.1
    known = InformedSpace.make(lifted.space, jnp.full(dim, 0.3), jnp.asarray(precision))
    problems = (dataclasses.replace(lifted, space=known),)
    theta = jnp.zeros(gauss_newton.theta_length(problems))
    off, found = gauss_newton.prior_terms(problems, theta)
    np.testing.assert_allclose(off[:dim], -0.3, rtol=1e-6)
    np.testing.assert_allclose(found[:dim, :dim], precision, rtol=1e-6)
    np.testing.assert_allclose(found[dim:, dim:], np.eye(len(theta) - dim))
    end, _ = valley(lifted, len(theta))
    alone = dataclasses.replace(
        end.normal, matrix=0 * end.normal.matrix, scatter=0 * end.normal.scatter
    )
    nothing = dataclasses.replace(end, theta=theta - off, normal=alone)
    told = errors_by(problems, nothing, 1.0, [])[:dim, :dim]
    np.testing.assert_allclose(np.linalg.inv(told), precision, rtol=1e-6, atol=1e-9)


def test_where_an_estimate_errs_by_more_than_noise_its_posterior_is_that_of_less_information(
    lifted,
):
    """Against the posterior of a normal distribution; the end is that of noise alone."""
    random = np.random.default_rng(1)
    dim, size = lifted.space.dim, gauss_newton.theta_length((lifted,))
    root, other = random.normal(size=(2, size, 2 * size))
    known = np.eye(size)
    known[:dim, :dim] = (other @ other.T)[:dim, :dim]
    mean = np.zeros(size)
    mean[:dim] = 0.4
    space = InformedSpace.make(
        lifted.space, jnp.asarray(mean[:dim]), jnp.asarray(known[:dim, :dim])
    )
    problems = (dataclasses.replace(lifted, space=space),)
    told, seen = root @ root.T + 50 * np.eye(size), 0.4 + 0.1 * random.normal(size=size)
    both = np.linalg.inv(told + known)
    end, _ = valley(lifted, size)
    normal = dataclasses.replace(end.normal, matrix=jnp.asarray(0.01 * told))
    theta = both @ (told @ seen + known @ mean)
    normal = dataclasses.replace(normal, gradient=jnp.asarray(0.01 * told @ (theta - seen)))
    end = dataclasses.replace(end, theta=jnp.asarray(theta), normal=normal)
    prior = jnp.asarray(0.01)

    way, errors = _posterior(problems, end, prior, both)  # noise was all there is
    np.testing.assert_allclose(way, 0, atol=1e-6)
    np.testing.assert_allclose(errors, both, rtol=1e-5, atol=1e-9)
    less = told / 3  # the recordings err by more
    way, errors = _posterior(problems, end, prior, np.linalg.inv(less + known))
    expected = np.linalg.inv(less + known)
    np.testing.assert_allclose(errors, expected, rtol=1e-5, atol=1e-9)
    there = expected @ (less @ seen + known @ mean)
    np.testing.assert_allclose(theta + way, there, rtol=1e-5, atol=1e-8)
    way, _ = _posterior(problems, end, prior, 2 * np.linalg.inv(known))
    np.testing.assert_allclose(theta + way, mean, rtol=1e-5, atol=1e-8)


def staying(lifted, raw, off, bias):
    """The `settled` variance and bias of an end, whose prior has a variance of 1/16 for each number
    of a fabric, `off` its mean by so much; `raw` is the variance without the prior."""
    dim, size = lifted.space.dim, gauss_newton.theta_length((lifted,))
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
    by = MeshError(theirs, np.outer(theirs, theirs))
    at, flat, _ = settled((lifted,), other, end, one, covariance, by)
    there, found, left = settled(problems, other, end, one, covariance, by)
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


def test_a_covariance_that_rounding_left_singular_has_errors_too(lifted):
    """Two numbers of which single precision tells only a combination."""
    size = gauss_newton.theta_length((lifted,))
    broken = 1e-4 * np.eye(size)
    broken[0, 1] = broken[1, 0] = 1e-4 * (1 + 1e-6)
    assert np.linalg.eigvalsh(broken)[0] < 0
    mended = _positive(broken)
    assert np.linalg.eigvalsh(mended)[0] > 0
    np.testing.assert_allclose(mended, broken, atol=1e-9)


def test_what_tests_measured_draws_an_estimate_only_as_far_as_the_finer_mesh_allows(
    lifted, monkeypatch
):
    """All the way where that fits as well there, half of it where only that does, else not."""
    dim, size = lifted.space.dim, gauss_newton.theta_length((lifted,))
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

        monkeypatch.setattr("r2s.estimation.mesh_bias.predictions_at", lambda _, theta: theta)
        monkeypatch.setattr("r2s.estimation.mesh_bias.loss_from", loss)
        other = OtherMesh(problems, factor(ratio))
        by = MeshError(bias, np.diag(bias**2))
        theta, errors, _ = settled(problems, other, end, one, covariance, by)
        return float(end.theta[0] - theta[0]), np.sqrt(errors[0, 0])

    whole, error = went(1.0)
    assert whole == pytest.approx(0.1, rel=0.01) and error == pytest.approx(0.01, rel=0.01)
    half, error = went(0.6 * whole)
    assert half == pytest.approx(whole / 2, rel=1e-5)
    assert error == pytest.approx(np.hypot(0.01, whole / 2), rel=0.01)  # which hold what is left
    assert went(1e-4)[0] == 0 and went(1.0, ratio=2.0)[0] == 0  # a coarser mesh allows nothing


def errors_by(problems, end, prior, led, is_truth=False):
    """`covariance` where steps lead from places and their normal equations."""
    return covariance(problems, end, prior, steps_apart(problems, end, prior, led), is_truth)


def valley(lifted, size):
    """The end of a descent in a quadratic loss, and what the loss is at any place."""
    random = np.random.default_rng(0)
    root = random.normal(size=(size, 2 * size))
    matrix = jnp.asarray(root @ root.T)
    end = jnp.full(size, 0.5).at[lifted.space.dim :].set(0.0)

    def at(place, gradient: Any = 0.0, loss: Any = 0.0):
        found = matrix @ (place - end) + gradient
        one = jnp.ones(())
        return Normal(loss * one, one, one, found, matrix, 1e-4 * matrix)

    one = jnp.ones(())
    return Descent(end, at(end), one, one, one, jnp.zeros((), int)), at


def test_deviations_are_those_of_a_smooth_loss_or_of_how_far_descents_lie_apart(lifted):
    problems, prior = (lifted,), 1e-9
    size = gauss_newton.theta_length(problems)
    end, at = valley(lifted, size)
    alone = errors_by(problems, end, prior, [])
    np.testing.assert_allclose(alone, 1e-4 * jnp.linalg.inv(end.normal.matrix), rtol=1e-5)
    places = sample_around(problems, end, prior, 64, jr.key(0))
    off = places - end.theta[None]
    np.testing.assert_allclose(jnp.mean(off, axis=0), 0, atol=1e-12)  # in opposite pairs
    far = jnp.einsum("pu,uv,pv->p", off, jnp.linalg.inv(alone), off)
    np.testing.assert_allclose(far, size, rtol=1e-4)  # a deviation along each axis
    back = [(place, at(place)) for place in places]
    np.testing.assert_allclose(errors_by(problems, end, prior, back), alone, rtol=1e-6)
    # descents that would all end one way, but for one that would end anywhere
    away = jnp.linalg.cholesky(alone)[:, 0] * 5

    def push(times):
        return -end.normal.matrix @ away * times

    pushes = [1e6, *(1.0 if i % 2 else -1.0 for i in range(63))]
    led = [(place, at(place, push(t))) for place, t in zip(places, pushes, strict=True)]
    rough = errors_by(problems, end, prior, led)
    expected = alone + jnp.outer(away, away) * (63 + FARTHEST**2) / 65
    np.testing.assert_allclose(rough, expected, rtol=1e-3, atol=1e-12)
    # a run that diverged, or whose derivatives did, says that its place is no better known
    for loss, gradient in ((jnp.inf, away * jnp.nan), (1.0, away * jnp.nan), (1.0, away / 0)):
        pair = jnp.asarray(loss), gradient
        broken = eqx.tree_at(lambda n: (n.loss, n.gradient), at(end.theta), pair)
        lost = errors_by(problems, end, prior, [(place, broken) for place in places[:2]])
        assert np.all(np.isfinite(lost)) and np.all(np.diag(lost) > np.diag(alone))


def test_of_the_true_fabric_where_its_end_leads_is_noise(lifted):
    problems, prior = (lifted,), 1e-9
    end, at = valley(lifted, gauss_newton.theta_length(problems))
    noise = jnp.arange(1.0, len(end.theta) + 1)
    noisy = dataclasses.replace(end, normal=at(end.theta, noise))

    def found(end, noise, true):
        return errors_by(
            problems, end, prior, [(p, at(p, noise)) for p in (end.theta + 0.01, end.theta)], true
        )

    np.testing.assert_allclose(found(noisy, noise, True), found(end, 0.0, False), rtol=1e-6)
    assert np.all(np.diag(found(noisy, noise, False)) > np.diag(found(noisy, noise, True)))


def test_steps_lead_apart_alike_on_a_mesh_whose_own_end_leads_elsewhere(lifted):
    problems, prior = (lifted,), 1e-9
    end, at = valley(lifted, gauss_newton.theta_length(problems))
    places = sample_around(problems, end, prior, 4, jr.key(0))

    def apart(bias):
        led = [(p, at(p, 1.0 * i + bias)) for i, p in enumerate(places)]
        own = jnp.arange(1.0, len(end.theta) + 1) + bias
        return steps_apart(
            problems, dataclasses.replace(end, normal=at(end.theta, own)), prior, led
        )

    assert np.max(np.abs(apart(0.0))) > 1e-2
    np.testing.assert_allclose(apart(3.0), apart(0.0), rtol=1e-5, atol=1e-9)


def test_the_coarser_of_two_meshes_is_the_same_from_either_but_for_what_stays(lifted):
    coarse, fine = [tuple(dataclasses.replace(lifted) for _ in range(2)) for _ in range(2)]
    to_finer, to_coarser = OtherMesh(fine, factor(0.5)), OtherMesh(coarse, factor(2.0))
    assert to_finer.is_finer and not to_coarser.is_finer
    for problems, other in ((coarse, to_finer), (fine, to_coarser)):
        found, beside = coarser_of(problems, other)
        for which in (0, 1):
            assert found[which] is coarse[which] and beside[which].problems[0] is fine[which]
            assert beside[which].factor == to_finer.factor
    pulled = (pull(fine[0]), fine[1])
    found, beside = coarser_of(pulled, to_coarser)
    assert found[0] is pulled[0] and found[1] is coarse[1]
    assert beside[0].problems[0] is coarse[0] and beside[0].factor == to_coarser.factor
    assert beside[1].problems[0] is fine[1] and beside[1].factor == to_finer.factor
    assert coarser_of(coarse, to_finer)[0] is coarse  # so that places are not derived again
    assert coarser_of(coarse, None) == (coarse, ())


def pull(problem: Problem) -> Problem:
    """The problem with a force, as that of a pull."""
    count = len(problem.frames)
    force = Force(jnp.zeros((count, 1)), jnp.ones(count, bool), jnp.eye(3)[:1])
    return dataclasses.replace(problem, force=force)


def test_where_derivatives_overflow_nothing_is_known(lifted):
    problems, prior = (lifted,), 1e-9
    size = gauss_newton.theta_length(problems)
    end, at = valley(lifted, size)
    broken = eqx.tree_at(lambda e: e.normal.scatter, end, jnp.full((size, size), jnp.inf))
    near = [(end.theta, at(end.theta))] * 2
    known = np.diag(errors_by(problems, broken, prior, near))
    dim = lifted.space.dim
    np.testing.assert_allclose(known[:dim], UNIFORM_DEVIATION**2)
    np.testing.assert_allclose(known[dim:], 1)


@pytest.mark.slow(group="estimates")
def test_deviations_hang_on_no_limit_and_hardly_on_rounding():
    """Of an end that is moved by less than single precision resolves, and of a mesh that moves
    alike: two answers would differ by far."""
    problems, budget = (lift(8),), Budget(around=4)
    nuisances = jnp.zeros(gauss_newton.theta_length(problems) - FAMILY.dim)
    theta, zero = jnp.concatenate([FAMILY.to_unit(FABRIC), nuisances]), jnp.zeros(())

    def found(theta, tried_on=None):
        normal = compiled.normal_at(problems, theta, zero, None)
        end = Descent(theta, normal, zero, zero, zero, jnp.zeros((), int))
        return np.sqrt(np.diag(covariance_at(problems, budget, end, jr.key(0), tried_on=tried_on)))

    whole = found(theta)
    np.testing.assert_allclose(found(theta * (1 + 3e-7)), whole, rtol=0.05)
    np.testing.assert_allclose(found(theta, tried_on=(*problems,)), whole, rtol=1e-3)


@pytest.mark.slow(group="estimates")
def test_an_estimate_says_what_was_in_doubt(lifted):
    """And places around its end have a say in its deviations alone."""
    budget = Budget(coarse=0, starts=1, iterations=1, around=0)

    def run(budget):
        return descend(lifted, budget, key=jr.key(0))

    alone, found = run(budget), run(budget._replace(around=4))
    np.testing.assert_array_equal(found.values, alone.values)
    np.testing.assert_array_equal(found.losses, alone.losses)
    assert np.all(found.standard_errors > 0) and np.all(np.isfinite(found.standard_errors))
    assert np.max(np.abs(found.standard_errors / alone.standard_errors - 1)) > 1e-3
    lines = describe(found)
    assert any(line.startswith("shift x") and " m " in line for line in lines)


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
    assert default_nuisance_prior(still, Doubt(here, nowhere, air=0.5)).air == 0.5
    assert (
        default_nuisance_prior(windy, Doubt(here, nowhere)).air == default_nuisance_prior(windy).air
    )
    with pytest.raises(ValueError, match="negative"):
        Doubt(here, nowhere, air=-1.0)


def test_a_wind_whose_force_is_in_doubt_weighs_nothing(blown, lifted):
    force = Force(jnp.zeros((1, 3)), jnp.ones(1, bool), jnp.eye(3))
    pulled = dataclasses.replace(lifted, force=force)
    assert weighing((blown, lifted, pulled)) == [False, False, True]


@pytest.mark.slow(group="estimates")
def test_cma_es_tells_the_nuisances_with_which_it_has_its_loss(lifted):
    pytest.importorskip("cma")
    found = cma_es.search(lifted, evaluations=40, key=jr.key(0))
    free = list(nuisances_that_vary((lifted,)))
    assert [each.name for each in found.nuisances] == [each.name for each in free] != []
    theta = np.zeros(gauss_newton.theta_length((lifted,)))
    theta[: lifted.space.dim] = lifted.space.to_unit(found.fabric)
    for each, told in zip(free, found.nuisances, strict=True):
        assert np.isnan(told.standard_error)
        theta[each.place] = told.value / each.scale
    loss = float(gauss_newton.loss_at((lifted,), jnp.asarray(theta, float)))
    assert found.loss == pytest.approx(loss, rel=1e-3)
    assert np.abs(theta[lifted.space.dim :]).max() > 0.1
