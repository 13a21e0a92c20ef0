"""Estimators: their derivatives, what they say of the recordings, files, and resumed runs."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import end_at
from windows import window

from r2s import scenarios
from r2s.estimation import descent, gauss_newton, methods, prediction
from r2s.estimation.estimate import as_json, from_json
from r2s.estimation.gauss_newton import normals_at
from r2s.estimation.judgement import descend, sensitivity
from r2s.estimation.method import Budget
from r2s.estimation.normal_equations import loss_of, normal_equations_of
from r2s.estimation.prediction import Prediction, Sensitivity, predict, sensitivities
from r2s.estimation.problem import OWN, NuisancePrior, Problem, beginning, problems_on_mpm
from r2s.materials import presets
from r2s.materials.parameters import IsotropicSpace, OrthotropicSpace
from r2s.recordings.recording import set_time_offset
from r2s.scenarios import synthetic

ALL = NuisancePrior(time=0.05, density=0.2, air=0.3, size=0.05)
SMALL = Budget(num_samples=2, num_starts=1, max_iterations=4, frame_fractions=(0.5,), num_probes=2)
FABRIC = presets.grey_interlock()
FAMILY = OrthotropicSpace.make(float(FABRIC.density))


@pytest.fixture(scope="module")
def recording():
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 0.6}
    experiment = scenarios.lifting(num_frames=8, interval=1 / 10, **motion)
    return synthetic.record(experiment, FABRIC, "grey", shape=(5, 5), key=jr.key(1))


@pytest.fixture(scope="module")
def small(recording):
    """A problem of four frames on a coarse sheet, of which nothing is known for sure."""
    return Problem.make(recording, FAMILY, num_points=60, shape=(5, 5), nuisance_prior=ALL)


@pytest.fixture(scope="module")
def pull():
    """A recorded stretching of few frames, with markers and force."""
    experiment = scenarios.stretching(num_frames=6, interval=1 / 10, strain=0.03, moving=0.4)
    return synthetic.record(experiment, FABRIC, "grey", shape=(5, 5), key=jr.key(3))


@pytest.fixture(scope="module")
def pulled(pull):
    return Problem.make(pull, FAMILY, shape=(5, 5))


@pytest.fixture(scope="module")
def estimated(small):
    return descend(small, SMALL, key=jr.key(0))


def normal_at(problems, theta, scale=0.0):
    """By the program that a descent runs, which is compiled once for both."""
    return normals_at(problems, [theta], [jnp.asarray(scale, float)])[0]


AWAY = jnp.array([0.1, -0.2, 0.5, 0.1, 0.3, 0.2, -0.1, 0.4])


PULLED = pytest.param("pulled", marks=pytest.mark.slow(group="estimates"))


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize("scale", [0.0, 0.01])
@pytest.mark.parametrize("kind", ["small", PULLED])
def test_the_objective_has_the_gradient_that_differences_have(kind, scale, request):
    """Gauss-Newton's gradient is that of the whole rollout: contact, nearest points, force."""
    problems = (request.getfixturevalue(kind),)
    theta = jnp.concatenate([jnp.full(7, 0.45), AWAY])
    normal = normal_at(problems, theta, scale)
    found = normal.gradient
    width = 1e-4 if kind == "small" else 1e-3  # forces of a stiff sheet are rounded more
    least = 1e-6 * float(jnp.max(jnp.abs(found)))
    assert normal.loss == pytest.approx(float(jax.jit(_loss)(problems, theta, scale)))
    for index in range(1 if scale else 0, 15, 2):  # at each scale the other half of them
        steps = [normal_at(problems, theta.at[index].add(s * width), scale).loss for s in (1, -1)]
        difference = float(steps[0] - steps[1]) / (2 * width)
        assert float(found[index]) == pytest.approx(difference, rel=2e-3, abs=least)
    moved = 15 if kind == "small" else 11  # what is not in doubt does not move it
    assert np.count_nonzero(np.asarray(found)) == moved


def _loss(problems, theta, scale):
    return gauss_newton.loss_at(problems, theta, scale=scale)


@pytest.mark.slow(group="estimates")
def test_a_narrow_secant_is_the_derivative(small):
    theta = jnp.concatenate([jnp.full(7, 0.45), AWAY])
    _, exact = jax.jit(sensitivities)(small, theta)
    _, secant = jax.jit(lambda p, u: sensitivities(p, u, 1e-4))(small, theta)
    largest = float(jnp.max(jnp.abs(exact.x)))
    assert np.asarray(secant.x) == pytest.approx(np.asarray(exact.x), abs=1e-4 * largest)


@pytest.mark.slow(group="estimates")
def test_an_early_camera_is_predicted_as_an_early_recording(recording):
    """Clouds on a clock that is a frame early are explained, by that delay, as on the right one."""
    late = set_time_offset(recording, -0.1)
    nuisance_prior = NuisancePrior(time=0.1)
    place = FAMILY.to_unit(FABRIC)

    def theta(delay):
        return jnp.concatenate([place, jnp.zeros(7), jnp.array([delay])])

    loss = jax.jit(lambda p, u: loss_of(p, predict(p, u)))

    def whole(r):
        return Problem.make(r, FAMILY, num_points=60, shape=(5, 5), nuisance_prior=nuisance_prior)

    def make(r):
        return window(whole(r), 4, 6)  # the simulation ends where the recording does

    same, shifted = float(loss(make(recording), theta(0.0))), make(late)
    assert float(loss(shifted, theta(-1.0))) == pytest.approx(same, rel=0.02)
    assert float(loss(shifted, theta(0.0))) > 2 * same


def test_of_many_descents_the_better_half_go_on():
    """After every third iteration, until three are left; a diverged one goes first."""
    losses = [float("nan"), *np.random.default_rng(0).permutation(15).astype(float)]
    row = [end_at(np.zeros(2), loss) for loss in losses]
    order = [int(i) for i in np.argsort(losses)]  # NaN is last
    kept = [descent._kept(row, iteration) for iteration in range(1, 13)]
    assert [len(each) for each in kept] == [16] * 3 + [8] * 3 + [4] * 3 + [3] * 3
    assert all(each == sorted(order[: len(each)]) for each in kept)


@pytest.mark.slow(group="estimates")
def test_a_marker_that_is_off_in_every_frame_is_one_error(pulled):
    """Like the error of its place in the first frame: twice the frames are no more information."""
    markers = pulled.markers
    rest = jnp.pad(pulled.scenario.scene.mesh.rest, ((0, 0), (0, 1)))
    expected = jnp.einsum("mk,mki->mi", markers.weights, rest[markers.vertices])
    off = 1e-3 * jr.normal(jr.key(0), expected.shape)
    slope = 0.1 * jr.normal(jr.key(1), (len(pulled.frames), *rest.shape, 3))  # of a made-up motion

    def deviations(times):
        count = times * len(pulled.frames)
        positions = jnp.broadcast_to(expected + off, (count, *off.shape))
        seen = jnp.ones(positions.shape[:2], bool)
        moved = dataclasses.replace(markers, positions=positions, seen=seen)
        problem = dataclasses.replace(pulled, force=None, markers=moved)
        x = jnp.broadcast_to(rest, (count, *rest.shape))
        moves = Sensitivity(jnp.concatenate([slope] * times), None)
        found = jax.jit(normal_equations_of)(problem, Prediction(x, None, jnp.array(True)), moves)
        matrix = jnp.sum(found.matrices, axis=0)
        prior = 1e-6 * jnp.diag(jnp.diag(matrix))
        parts = found.scores, found.matrices, jnp.zeros_like(found.noise), prior, 1.0
        inverse = jnp.linalg.inv(matrix + prior)
        return np.sqrt(np.diag(inverse @ gauss_newton.scatter(*parts) @ inverse))

    np.testing.assert_allclose(deviations(2), deviations(1), rtol=1e-4)


@pytest.mark.slow(group="estimates")
def test_an_estimate_lowers_the_loss_and_survives_its_file(estimated):
    found = estimated
    assert np.nanmin(found.losses[-1]) < np.nanmin(found.losses[0])
    again = from_json(as_json(found))
    np.testing.assert_allclose(again.values, found.values)
    np.testing.assert_allclose(again.history, found.history)
    assert float(again.fabric.membrane.c12) == pytest.approx(float(found.fabric.membrane.c12))
    names = ["density ratio", "air ratio", "size ratio", *OWN]
    assert [c.name for c in again.nuisances] == names
    assert again.nuisances == found.nuisances
    assert repr(again.fits) == repr(found.fits)  # which hold NaN
    np.testing.assert_allclose(again.narrowing, found.narrowing)


@pytest.mark.slow(group="estimates")
def test_a_run_that_was_stopped_ends_as_if_it_had_not_been(small, estimated, tmp_path):
    path, whole = tmp_path / "descent.npz", estimated

    class Stop(Exception):
        pass

    def stop(iteration, loss):
        if iteration == 1:
            raise Stop

    with pytest.raises(Stop):
        descend(small, SMALL, checkpoint=path, progress=stop, key=jr.key(0))
    seen = []

    def count(iteration, loss):
        return seen.append(iteration)

    found = descend(small, SMALL, checkpoint=path, progress=count, key=jr.key(0))
    np.testing.assert_array_equal(found.values, whole.values)
    np.testing.assert_array_equal(found.losses, whole.losses)
    assert seen[0] == 2  # and did not begin again
    with pytest.raises(ValueError, match="is of another run .run .* there, .* asked"):
        descend(small, SMALL, checkpoint=path, key=jr.key(1))
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is no checkpoint"):
        descend(small, SMALL, checkpoint=path, key=jr.key(0))


def test_what_a_beginning_is(small):
    """A share of the frames that show something, and one at least; shares must rise."""
    assert small.clouds is not None
    mask = small.clouds.mask.at[0].set(False)
    late = dataclasses.replace(small, clouds=dataclasses.replace(small.clouds, mask=mask))

    def frames(problem: Problem, share: float) -> list[bool]:
        clouds = beginning(problem, share).clouds
        assert clouds is not None
        return np.any(clouds.mask, axis=1).tolist()

    assert frames(small, 0.5) == [True, True, False, False]
    assert frames(late, 0.67) == [False, True, True, False]
    assert frames(late, 0.01) == [False, True, False, False]
    with pytest.raises(ValueError, match="needs a start or more, got 0"):
        descend(small, SMALL._replace(num_starts=0), key=jr.key(0))
    for count in (3, -2):
        with pytest.raises(ValueError, match=f"in pairs, got {count}"):
            descend(small, SMALL._replace(num_probes=count), key=jr.key(0))
    for shares in ((0.5, 0.25), (0.5, 1.0), (0.0,), (0.5, 0.5)):
        with pytest.raises(ValueError, match="frame_fractions must rise between 0 and 1"):
            descend(small, SMALL._replace(frame_fractions=shares), key=jr.key(0))


def test_where_a_descent_was_it_does_not_derive_again(small, monkeypatch):
    """A place of all frames serves their beginning, but not the other way round; another place,
    another width or another recording does not serve."""
    derived = []

    def derive_one(problem, theta, width):
        derived.append((problem.scenario, float(theta[0]), width))
        one = jnp.zeros((1, 1, 3))
        return Prediction(one, None, jnp.array(True)), Sensitivity(one[..., None], None)

    monkeypatch.setattr(prediction, "_sensitivities", derive_one)
    derive = prediction.remembering()
    small = dataclasses.replace(small, nuisance_prior=ALL._replace(time=0.0))
    whole, early = (small,), (beginning(small, 0.01),)
    other = (dataclasses.replace(small, scenario=dataclasses.replace(small.scenario)),)
    there, elsewhere = jnp.full(15, 0.4), jnp.full(15, 0.6)
    (first,) = derive(early, there, None)
    (second,) = derive(whole, there, None)
    assert first is not second and len(derived) == 2  # more frames are needed
    for known in (whole, early, whole):
        assert derive(known, there, None)[0] is second
    assert len(derived) == 2
    for args in ((whole, elsewhere, None), (whole, there, 0.1), (other, there, None)):
        derive(*args)
    assert len(derived) == 5 and derive(whole, there, None)[0] is second
    monkeypatch.setattr(prediction, "REMEMBERED", 0)  # no room: only the latest place is known
    derive(whole, jnp.full(15, 0.7), None)
    derive(whole, there, None)
    assert len(derived) == 7


def test_markers_must_lie_on_the_sheet(pull):
    record = pull
    assert record.markers is not None and record.markers_seen is not None
    moved = dataclasses.replace(record, markers=record.markers + jnp.array([[[0.0, 0.3, 0.0]]]))
    with pytest.raises(ValueError, match="marker .* mm off the sheet"):
        Problem.make(moved, FAMILY, shape=(5, 5))
    lost = dataclasses.replace(record, markers_seen=record.markers_seen.at[0, 7].set(False))
    with pytest.raises(ValueError, match=r"markers \[7\] are not seen at rest"):
        Problem.make(lost, FAMILY, shape=(5, 5))


@pytest.mark.slow(group="estimates")
def test_a_loss_that_is_not_finite_at_the_start_is_an_error(small):
    def broken(problem, seen):
        return jnp.nan * jnp.sum(seen.x)

    with jax.numpy_dtype_promotion("standard"), pytest.raises(RuntimeError, match="not finite"):
        methods.adam(small, broken, approach="test", epochs=2, rate=0.1)


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize("name", ["camel_ponte_roma", "grey_interlock"])
def test_a_known_fabric_and_a_late_clock_are_found(name):
    """What the lift determines is within three deviations of the truth, and so is the delay."""
    fabric = presets.FIVE[name]()
    record = synthetic.record(scenarios.lifting(), fabric, name, key=jr.key(0))
    record = dataclasses.replace(record, times=record.times + 0.08)  # grippers rest at the end
    space = OrthotropicSpace.make(float(fabric.density))
    problem = Problem.make(record, space, nuisance_prior=NuisancePrior(time=0.1))
    found = descend(problem, approach="test", key=jr.key(0))
    truth = np.asarray(space.values(space.to_unit(fabric)))
    narrowed = found.narrowing < 0.05
    assert narrowed.sum() >= 3
    error = np.abs(np.where(truth > 0, found.values / truth - 1, found.values - truth))
    assert np.all(error[narrowed] < 0.1)
    delay = found.nuisances[-1]
    assert delay.name == "time" and abs(delay.value - 0.08) < 0.01


@pytest.mark.slow(group="estimates")
def test_a_planned_motion_reveals_more_with_better_cameras():
    """And one that does not move reveals less than one that does."""

    def deviations(height, noise):
        experiment = scenarios.lifting(num_frames=8, interval=1 / 10, height=height, moving=0.6)
        seen = synthetic.sensing(experiment)
        seen = seen._replace(noise=noise, outliers=1e-3)
        record = synthetic.record(
            experiment, FABRIC, "grey", seen=seen, shape=(5, 5), key=jr.key(1)
        )
        problem = Problem.make(record, FAMILY, num_points=60, shape=(5, 5))
        return sensitivity(problem, FABRIC).standard_errors

    good, bad, low = deviations(0.2, 3e-4), deviations(0.2, 3e-3), deviations(0.05, 3e-4)
    assert np.all(np.isfinite(good)) and np.all(good > 0)
    assert np.median(good / bad) < 0.5
    assert np.median(good / low) < 0.8


@pytest.mark.slow(group="estimates")
def test_material_points_find_a_known_modulus():
    """Of an isotropic sheet, by DiffCP."""
    from r2s.scenarios import mpm_cloth

    space = IsotropicSpace.make(0.2, plate=5e-4)
    place = jnp.array([0.3, 0.6])
    experiment = scenarios.lifting(num_frames=6, interval=1 / 10, height=0.15, moving=0.4)
    record = synthetic.record(
        experiment,
        space(place),
        "sheet",
        shape=(4, 4),
        solver=lambda scenario, fabric: mpm_cloth(scenario, space(jnp.ones(2))),
        key=jr.key(0),
    )
    budget = Budget(num_samples=0, num_starts=1, max_iterations=6, secant_width=0.02, num_probes=2)
    start = jnp.array([0.25, 0.5])
    found = descend(problems_on_mpm([record], space, (4, 4)), budget, start=start, key=jr.key(0))
    truth = np.asarray(space.values(place))
    spread = found.standard_errors * np.where([b.log for b in space.ranges], truth, 1)
    assert np.all(np.abs(found.values - truth) < 4 * spread)
    assert found.standard_errors[0] < 0.3  # of the modulus
