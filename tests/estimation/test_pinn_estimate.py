"""Stiffness from closed forms and from the cloth solver, and what lacks without force."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.estimate import as_json, from_json
from r2s.estimation.pinn import estimator, published_recipe
from r2s.estimation.pinn.estimator import estimate, fit
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Clamp, Pull, pull_from, pulled, stacked
from r2s.estimation.pinn.training import Recipe, train
from r2s.estimation.pinn.weak_form import equilibrium, prepare
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace, ParameterSpace, StiffeningSpace
from r2s.scenarios import fling, folding, shaking
from r2s.scenarios.scenario import rollout

SIZE, DENSITY, FRAMES = (0.45, 0.45), 0.2, 6
WARP, PULLED = 80.0, 0.02  # [N/m], [m]
NOISE = (2e-4, 0.01)


def even_pull(force: bool = True, seed: int = 0, frames: int = FRAMES, growth: float = 0.0) -> Pull:
    """A sheet without coupling that stretches evenly: its exact motion, whatever the clamps.

    `growth`: of its stiffness with the stretch, up to the end, [-].
    """
    times = jnp.linspace(0.0, 1.0, frames)
    along = (jnp.arange(4.0) + 0.5) / 4 * SIZE[0]
    places = jnp.stack(jnp.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
    far = jnp.stack([PULLED * times, 0 * times], axis=1)
    zero = jnp.zeros((frames, 2))
    moved = places[None, :, :1] / SIZE[0] * far[:, None]
    e = PULLED * times / SIZE[0]
    tension = WARP * (1 + growth * times) * (1 + e) * ((1 + e) ** 2 - 1) / 2
    return Pull(
        size=jnp.array(SIZE),
        angle=jnp.zeros(()),
        places=places,
        displacement=moved + 1e-6 * jr.normal(jr.key(seed), moved.shape),
        seen=jnp.ones((frames, 16), bool),
        times=times,
        near=Clamp(zero, zero, zero),
        far=Clamp(far, jnp.array([[PULLED, 0.0]]) + zero, zero),
        force=tension * SIZE[1] if force else None,
        gravity=jnp.zeros(2),
        normal=jnp.zeros(()),
    )


def small_network(pull: Pull) -> Network:
    high = jnp.concatenate([pull.size, pull.times[-1:]])
    scale = jnp.asarray(1e-3, float)
    return Network.make(high, scale, width=5, layers=3, key=jr.key(1))


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Few virtual displacements, so that it compiles fast; the slow tests undo it."""
    monkeypatch.setattr(estimator, "DEGREES", (3, 3))
    monkeypatch.setattr(estimator, "prepare", lambda n, p, _: prepare(n, p, (3, 3)))


FAMILY = OrthotropicSpace.make(DENSITY)


def fitted(pull: Pull, space: ParameterSpace = FAMILY, **options):
    return fit(space, [small_network(pull)], [pull], np.full(space.dim, 0.5), NOISE, **options)


@pytest.mark.slow(group="pinn")
def test_an_even_stretch_gives_the_warp_of_the_closed_form():
    """And not what it does not depend on: weft and shear keep the deviation of their range."""
    estimated = fitted(even_pull())
    assert estimated.converged
    values = np.asarray(FAMILY.values(jnp.asarray(estimated.place)))
    np.testing.assert_allclose(values[0], WARP, rtol=2e-3)
    np.testing.assert_allclose(values[3], 0.0, atol=2e-3)
    deviations = np.sqrt(np.diag(estimated.covariance)) * math.sqrt(12)  # of a flat range's
    assert deviations[0] < 1e-2 and deviations[2] > 0.5 and deviations[4] > 0.99


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("growth", [0.0, 0.05, 0.2])
def test_growing_stiffness_is_an_error_of_that_at_small_strain(growth):
    """A constant stiffness is a mean over the pull; half of the stretch tells how far it is off."""
    pull = even_pull(frames=21, growth=growth)
    estimated = fitted(pull)
    assert estimated.converged
    value = float(FAMILY.values(jnp.asarray(estimated.place))[0])
    length = math.log(FAMILY.ranges[0].high / FAMILY.ranges[0].low)
    off = math.log(value / WARP) / length
    errors = np.sqrt(np.diag(estimated.law))
    assert off >= 0.7 * growth / length - 3e-4  # the mean weighs what is far stretched
    assert 0.8 * off <= errors[0] <= 1.5 * abs(off) + 2e-3
    assert errors[4] < 1e-3  # a flat sheet does not determine bending
    stiffening = fitted(pull, StiffeningSpace.make(FAMILY), steps=1)
    assert stiffening.law.shape == (10, 10) and not stiffening.law.any()


PLACE = np.array([0.5, 0.4, 0.6, 0.7, 0.5, 0.5, 0.5])


@pytest.mark.slow(group="pinn")
def test_without_force_the_scale_is_not_identifiable():
    """Motions in equilibrium are the same when all stiffnesses are doubled: only the force
    differs."""
    pull = even_pull(force=False)
    given = prepare(small_network(pull), pull, (3, 3))
    logs = [math.log(bound.high / bound.low) for bound in FAMILY.ranges[:3]]
    stiffer = PLACE + np.array([*(math.log(2) / log for log in logs), 0, 0, 0, 0])
    soft, stiff = (equilibrium(FAMILY, jnp.asarray(p), pull, *given) for p in (PLACE, stiffer))
    # but for inertia, which is less than 1e-3 of the stress
    np.testing.assert_allclose(soft.coefficients, stiff.coefficients, atol=2e-5)
    np.testing.assert_allclose(stiff.force[1:], 2 * soft.force[1:], rtol=1e-2)


@pytest.mark.slow(group="pinn")
def test_derivatives_of_the_motion_in_equilibrium_against_differences():
    pull = dataclasses.replace(even_pull(), normal=jnp.asarray(9.81))  # with friction
    given = prepare(small_network(pull), pull, (3, 3))

    def observed(place):
        motion = equilibrium(FAMILY, jnp.asarray(place), pull, *given)
        return motion, np.concatenate([np.ravel(motion.markers) / 1e-3, motion.force])

    motion, _ = observed(PLACE)
    for i in (0, 3, 5, 6):
        step = 1e-4 * np.eye(7)[i]
        differences = (observed(PLACE + step)[1] - observed(PLACE - step)[1]) / 2e-4
        markers = np.ravel(motion.markers_by_place[..., i]) / 1e-3
        slope = np.concatenate([markers, motion.force_by_place[:, i]])
        np.testing.assert_allclose(slope, differences, rtol=2e-2, atol=2e-2 * np.abs(slope).max())


@pytest.mark.slow(group="pinn")
def test_a_frame_that_is_not_in_equilibrium_does_not_count(monkeypatch):
    """Its derivative may come out as anything, and would decide the estimate."""
    pull, place = even_pull(), jnp.asarray(PLACE)
    given, start = prepare(small_network(pull), pull, (3, 3))
    whole = equilibrium(FAMILY, place, pull, given, start)
    assert whole.is_balanced.all()
    broken = eqx.tree_at(
        lambda g: g.even.acceleration, given, given.even.acceleration.at[3].set(jnp.nan)
    )
    motion = equilibrium(FAMILY, place, pull, broken, start)
    others = np.arange(len(pull.times)) != 3
    np.testing.assert_array_equal(motion.is_balanced, others)
    np.testing.assert_allclose(motion.force[others], whole.force[others], rtol=1e-3)
    one, other = (np.asarray(each.force_by_place)[others] for each in (motion, whole))
    np.testing.assert_allclose(one, other, atol=0.1 * np.abs(other).max())
    nowhere = eqx.tree_at(lambda g: g.even.acceleration, given, jnp.nan * given.even.acceleration)
    monkeypatch.setattr(estimator, "prepare", lambda *_: (nowhere, start))
    with pytest.raises(RuntimeError, match="no pull has a motion in equilibrium"):
        fit(FAMILY, [small_network(pull)], [pull], PLACE, NOISE)


TINY = Recipe(warm_up=20, adam=20, chunk=10, width=6, layers=3)


@pytest.fixture
def promotion():
    """optax multiplies numbers of different kinds."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.mark.slow(group="pinn")
def test_an_estimate_from_two_pulls_survives_its_file(promotion):
    estimated = estimate([even_pull(seed=i) for i in range(2)], FAMILY, TINY, key=jr.key(0))
    np.testing.assert_allclose(estimated.values[0], WARP, rtol=5e-3)
    assert estimated.narrowing[0] < 0.05 and estimated.narrowing[4] > 0.9
    assert "2 pulls" in estimated.approach
    np.testing.assert_allclose(from_json(as_json(estimated)).values, estimated.values)


@pytest.mark.slow(group="pinn")
def test_without_force_the_report_says_so(promotion):
    estimated = estimate([even_pull(force=False)], FAMILY, TINY, key=jr.key(0))
    assert "not identifiable" in estimated.approach
    scale = {nuisance.name: nuisance for nuisance in estimated.nuisances}["stiffness scale"]
    assert scale.standard_error > 0.3 * scale.value
    assert (estimated.narrowing[:3] > 0.1).all()


@pytest.mark.slow(group="pinn")
def test_a_killed_training_continues_from_its_checkpoint(promotion, tmp_path):
    """To the same network, which fits the markers better than an untrained one."""
    pulls, options = stacked([even_pull()]), {"checkpoint": tmp_path / "training.npz"}

    class Killed(Exception):
        pass

    def kill(chunk, loss):
        del loss
        if chunk == 1:
            raise Killed

    chunks = []
    whole = train(FAMILY, pulls, TINY, key=jr.key(5))
    with pytest.raises(Killed):
        train(FAMILY, pulls, TINY, report=kill, key=jr.key(5), **options)
    report = lambda chunk, loss: chunks.append(chunk)  # noqa: E731
    resumed = train(FAMILY, pulls, TINY, report=report, key=jr.key(5), **options)
    with pytest.raises(ValueError, match="is of another run"):
        train(FAMILY, pulls, TINY, key=jr.key(6), **options)
    assert chunks == [2, 3]
    np.testing.assert_array_equal(resumed.places, whole.places)
    assert eqx.tree_equal(resumed.model, whole.model)
    assert whole.losses[-1] < 0.5 * whole.losses[0]


def test_the_papers_weight_anneals():
    epochs = jnp.array([0, 499, 500, 4499, 4500, 9999])
    np.testing.assert_allclose(published_recipe.weight(epochs), [0.1, 0.1, 0.2, 0.9, 1.0, 1.0])


@pytest.mark.slow(group="pinn")
def test_a_step_that_went_astray_is_taken_back(promotion, monkeypatch):
    """To the model before it and without memory, when the losses are greater than they were."""
    monkeypatch.setattr(published_recipe, "LAYERS", 3)
    monkeypatch.setattr(published_recipe, "WIDTH", 5)
    pulls = published_recipe.without_force(stacked([even_pull(frames=4)]))
    assert pulls.force is None
    fresh, first = published_recipe.begin(FAMILY, pulls, key=jr.key(0)), jnp.asarray(0)
    good, loss = published_recipe.run(fresh, FAMILY, pulls, first, 1)
    assert not eqx.tree_equal(good.model, fresh.model) and np.isfinite(loss)
    worse = good._replace(before=jnp.zeros(()))
    back, _ = published_recipe.run(worse, FAMILY, pulls, first, 1)
    assert eqx.tree_equal(back.model, good.model) and eqx.tree_equal(back.ahead, good.model)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(back.lbfgs[0].diff_params_memory))
    assert np.isinf(back.before)


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("name", ["pink_solid", "grey_interlock"])
def test_the_fabric_of_simulated_pulls_is_estimated(name, promotion, monkeypatch):
    """Within 5 %, from 81 markers and a force with noise; and it simulates other motions."""
    monkeypatch.undo()
    fabric = presets.FIVE[name]()
    space = OrthotropicSpace.make(float(fabric.density))
    keys, angles = jr.split(jr.key(0), 3), (0.0, math.pi / 2, math.pi / 4)
    pulls = [
        pull_from(pulled(fabric, name, angle, shape=(33, 33), key=key))
        for angle, key in zip(angles, keys, strict=True)
    ]
    estimated = estimate(pulls, space, Recipe(), key=jr.key(1))
    truth = np.asarray(space.values(space.to_unit(fabric)))
    assert (estimated.standard_errors[:3] < 0.1).all()
    np.testing.assert_allclose(estimated.values[:3], truth[:3], rtol=0.05)
    np.testing.assert_allclose(estimated.values[3], truth[3], atol=0.05)
    for experiment in (folding(num_frames=40), fling(num_frames=25), shaking(num_frames=25)):
        assert bool(rollout(experiment.scenario((5, 5)), estimated.fabric).ok.all())
