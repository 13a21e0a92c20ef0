"""Pulls at an angle to the warp, by the cloth: another cut of the same fabric."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.cli.estimate import EstimateCard
from r2s.estimation.default_spaces import identified_law, law_of, with_law
from r2s.estimation.gauss_newton import least_weight, normal_from, prior_terms
from r2s.estimation.method import default_space
from r2s.estimation.methods import METHODS
from r2s.estimation.normal_equations import loss_of
from r2s.estimation.pinn.pulls import pulled
from r2s.estimation.prediction import derivatives_at, predict, predictions_at, theta_length
from r2s.estimation.problem import Problem
from r2s.materials import presets
from r2s.recordings.recording import load, save
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import from_recording, rollout

FABRIC = presets.camel_ponte_roma()
SPACE = default_space("cloth", float(FABRIC.density))
SHAPE = (4, 4)
EXACT = {"marker_noise": 0.0, "force_noise": 0.0, "steps": 2}  # those of the scenario
_predict, _rollout = eqx.filter_jit(predict), eqx.filter_jit(rollout)


def pull_of(degrees, key=0, **noise):
    """A short pull, recorded by markers and the clamp's force."""
    options = {"shape": SHAPE, "frames": 13, "strain": 0.03, "moving": 0.35, "key": jr.key(key)}
    return pulled(FABRIC, "camel", math.radians(degrees), **options, **noise)


@pytest.fixture(scope="module")
def bias():
    """Without noise."""
    return pull_of(30.0, **EXACT)


def at_angle(recording, degrees):
    """The recording as if the sheet had been cut at another angle."""
    return dataclasses.replace(recording, info=dataclasses.replace(recording.info, angle=degrees))


@pytest.mark.slow(group="pinn")
def test_the_true_fabric_predicts_a_pull_at_its_angle_and_no_other(bias):
    assert bias.info.angle == 30.0
    off = {}
    for degrees in (30.0, 70.0):
        problem = Problem.make(at_angle(bias, degrees), SPACE, shape=SHAPE)
        theta = jnp.zeros(theta_length((problem,))).at[: SPACE.dim].set(SPACE.to_unit(FABRIC))
        predicted, markers, force = _predict(problem, theta), problem.markers, problem.force
        assert markers is not None and force is not None and predicted.force is not None
        at = jnp.einsum("mk,tmki->tmi", markers.weights, predicted.x[:, markers.vertices])
        away = float(jnp.abs(at - markers.positions).max())
        missing = jnp.abs(predicted.force - force.values).max() / jnp.abs(force.values).max()
        off[degrees] = away, float(missing)
    # the force at the frames: a mean since the frame before lags by half a frame
    assert off[30.0][0] < 2e-4 and off[30.0][1] < 0.03
    assert off[70.0][0] > 3 * off[30.0][0] and off[70.0][1] > 2.5 * off[30.0][1]


@pytest.mark.slow(group="pinn")
def test_a_pull_along_the_weft_is_that_of_a_fabric_whose_yarns_are_swapped(bias):
    law = FABRIC.membrane
    swapped = dataclasses.replace(law, c11=law.c22, c22=law.c11)
    across, along = (from_recording(at_angle(bias, degrees), SHAPE) for degrees in (90.0, 0.0))
    expected = _rollout(along, dataclasses.replace(FABRIC, membrane=swapped)).x
    np.testing.assert_allclose(_rollout(across, FABRIC).x, expected, atol=2e-6)
    assert float(jnp.abs(_rollout(along, FABRIC).x - expected).max()) > 1e-4


def test_the_angle_is_part_of_a_recording_and_of_a_stretching_alone(bias, tmp_path):
    save(bias, tmp_path / "bias.npz")
    assert load(tmp_path / "bias.npz").info.angle == 30.0
    with pytest.raises(ValueError, match="finite"):
        dataclasses.replace(bias.info, angle=float("nan"))
    with pytest.raises(ValueError, match="'lifting'"):
        dataclasses.replace(bias.info, scenario="lifting")


def test_angles_of_the_command_line_are_those_of_the_stretchings_in_their_order(bias, tmp_path):
    info = dataclasses.replace(bias.info, scenario="wind", angle=0.0)
    other = dataclasses.replace(bias, info=info)
    command = EstimateCard((), 0.2, tmp_path / "out.json", angles=(45.0, 90.0))
    recordings = command._set_angles([bias, other, bias])
    assert [recording.info.angle for recording in recordings] == [45.0, 0.0, 90.0]
    with pytest.raises(ValueError, match="got 2 for 1 stretching"):
        command._set_angles([bias])


@pytest.mark.slow(group="estimates")
def test_diffcloud_finds_the_membrane_from_pulls_in_three_directions():
    """Each direction determines its own stiffness, and one alone no other."""
    recordings = [pull_of(degrees, key=i) for i, degrees in enumerate((0.0, 45.0, 90.0))]
    method = METHODS["diffcloud"](shape=SHAPE)
    together = method.estimate(recordings, SPACE, key=jax.random.key(0))
    alone = method.estimate(recordings[:1], SPACE, key=jax.random.key(0))
    truth = np.asarray(SPACE.values(SPACE.to_unit(FABRIC)))
    assert [bound.name for bound in SPACE.ranges[:3]] == ["warp", "weft", "shear"]
    off, errors = np.abs(np.log(together.values / truth))[:3], together.standard_errors[:3]
    assert (off < [0.03, 0.03, 0.15]).all() and (off < 3 * errors).all()
    assert (alone.standard_errors[1:3] > 3 * errors[1:]).all()


@pytest.mark.slow(group="estimates")
def test_a_lift_of_another_fabric_hardly_moves_what_a_pull_tells():
    """Points of a cloud err by a centimetre here, markers and a load cell by far less."""
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 0.8}
    lift = scenarios.lifting(num_frames=13, interval=1 / 10, **motion)
    args = {"seen": synthetic.WHOLE._replace(points=300, noise=0.01), "shape": SHAPE}
    other = presets.pink_solid()
    recordings = pull_of(0.0), synthetic.record(lift, other, "pink", key=jr.key(3), **args)
    problems = tuple(Problem.make(each, SPACE, shape=SHAPE) for each in recordings)
    theta = jnp.zeros(theta_length(problems)).at[: SPACE.dim]
    here, there = (theta.set(SPACE.to_unit(each)) for each in (FABRIC, other))
    predicted = derivatives_at(problems, here)
    pull, _ = predicted
    own = predictions_at(problems, there)
    left = [float(loss_of(p, seen)) for p, seen in zip(problems, (pull[0], own[1]), strict=True)]
    assert left[1] > 20 * left[0]  # of the noise of each

    def step_of_warp(weights):
        pairs = zip(problems, weights, strict=True)
        counted = tuple(dataclasses.replace(each, weight=jnp.array(w)) for each, w in pairs)
        found = normal_from(counted, here, predicted, jnp.zeros(()))
        prior = least_weight(counted, found.spread) * prior_terms(counted, here)[1]
        return abs(float(jnp.linalg.solve(found.matrix + prior, -found.gradient)[0]))

    assert step_of_warp([1 / each for each in left]) < step_of_warp([1.0, 1.0]) / 3


def test_a_pull_and_another_motion_determine_how_a_fabric_stiffens_and_softens(bias):
    """Neither alone does, nor a pull of which no force was recorded."""
    info = dataclasses.replace(bias.info, scenario="lifting", angle=0.0)
    motion = dataclasses.replace(bias, info=info)
    without = dataclasses.replace(bias, force=None, force_times=None)
    assert identified_law([motion, bias]) == "stiffening+softening"
    for others in ([], [bias], [bias, bias], [motion], [motion, without]):
        assert identified_law(others) == "linear"

    def law(recordings, **options: Any):
        card = EstimateCard((Path("lift.npz"),), 0.2, Path("card.json"), **options)
        return law_of(card._space(METHODS[card.method](), "flat", recordings).ranges)

    assert law([motion, bias]) == "stiffening+softening" and law([bias]) == "linear"
    assert law([motion, bias], law="linear") == law([motion, bias], method="diffcp") == "linear"


@pytest.mark.parametrize("law", ["linear", "stiffening", "softening", "stiffening+softening"])
def test_the_parameters_of_a_space_say_its_law(law):
    space = with_law(SPACE, law)
    assert law_of(space.ranges) == law
    assert [bound.name for bound in space.ranges[: SPACE.dim]] == [r.name for r in SPACE.ranges]
