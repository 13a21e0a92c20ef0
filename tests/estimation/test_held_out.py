"""A recording that an estimate was not made from says whether it is better than knowing nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation import held_out
from r2s.estimation.estimate import point_estimate
from r2s.estimation.held_out import HeldOut
from r2s.estimation.prediction import nuisances
from r2s.estimation.problem import Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.recording import MeasurementUncertainty
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import in_denser_air, rollout

SHAPE = (5, 5)


def called(recording, name, scenario="lifting"):
    info = dataclasses.replace(recording.info, name=name, scenario=scenario)
    return dataclasses.replace(recording, info=info)


@pytest.fixture(scope="module")
def lift():
    experiment = scenarios.lifting(num_frames=10, interval=0.3)
    fabric = presets.grey_interlock()
    return synthetic.record(experiment, fabric, "interlock", shape=SHAPE, key=jax.random.key(0))


def test_the_last_motion_with_clouds_is_held_out_of_three_or_more(lift):
    a, b = called(lift, "a"), called(lift, "b")
    pull = called(lift, "pull", "stretching")
    assert held_out.choose([a, b]) is None
    assert held_out.choose([a, b, pull]) == 1
    assert held_out.choose([pull, pull, pull]) is None
    assert held_out.choose([a, pull, pull]) is None  # nothing would be left to tell of bending
    assert held_out.choose([a, b, called(lift, "c")]) == 2
    assert held_out.choose([a, b, pull], held_out.NONE) is None
    assert held_out.choose([a, b], "a") == 0
    fold = called(lift, "fold", "folding")  # tells no fabrics apart
    assert held_out.choose([a, b, fold]) == 1
    assert held_out.choose([a, fold, fold]) == 0


def test_it_is_said_why_none_is_held_out(lift):
    a, b = called(lift, "a"), called(lift, "b")
    assert "3 recordings or more" in held_out.why_none([a, b])
    assert "two motions with clouds" in held_out.why_none([a, b, b])
    assert "was to be" in held_out.why_none([a, b, b], held_out.NONE)


def test_what_cannot_be_held_out_is_named(lift):
    a = called(lift, "a")
    with pytest.raises(ValueError, match="'x'; there are a"):
        held_out.choose([a], "x")
    with pytest.raises(ValueError, match="2 recordings"):
        held_out.choose([a, a], "a")
    with pytest.raises(ValueError, match="nothing is left"):
        held_out.choose([a], "a")
    without = dataclasses.replace(a, mask=jnp.zeros_like(a.mask))
    with pytest.raises(ValueError, match="no clouds"):
        held_out.choose([without, called(lift, "b")], "a")


@pytest.mark.slow(group="estimates")
def test_the_true_fabric_is_better_than_draws_and_a_wrong_one_is_not(lift):
    true = presets.grey_interlock()
    found = held_out.judge(lift, true, SHAPE, count=3)
    assert found.is_better and found.error < 4e-3 and len(found.defaults) + found.diverged == 3
    board = jax.tree.map(lambda leaf: leaf, true)
    board = dataclasses.replace(board, bending=jax.tree.map(lambda b: 1e4 * b, true.bending))
    wrong = held_out.judge(lift, board, SHAPE, count=3)
    assert not wrong.is_better and wrong.defaults == found.defaults


@pytest.mark.slow(group="estimates")
def test_a_motion_is_judged_in_the_air_that_was_found():
    fabric, thick = presets.grey_interlock(), 5.0
    experiment = scenarios.fling(num_frames=24)
    motion = rollout(in_denser_air(experiment.scenario(SHAPE), thick), fabric)
    fling = synthetic.record(
        experiment, fabric, "interlock", shape=SHAPE, motion=motion, key=jax.random.key(0)
    )
    found, written = (
        held_out.judge(fling, fabric, SHAPE, count=2, air=air) for air in (thick, 1.0)
    )
    assert found.error < 0.5 * written.error
    assert found.defaults != written.defaults


def test_the_air_is_the_one_that_an_estimate_names_where_a_recording_doubts_it(lift):
    doubt = MeasurementUncertainty((0.0, 0.0, 0.0), 0.0, air=0.5)
    doubted = dataclasses.replace(lift, info=dataclasses.replace(lift.info, doubt=doubt))
    space = OrthotropicSpace.make(float(presets.grey_interlock().density))
    problem = Problem.make(doubted, space, shape=SHAPE)
    theta = np.zeros(20)
    theta[space.dim + 1] = -1.0  # a standard deviation less
    found = nuisances((problem,), theta, theta)
    middle, nothing = jnp.full(space.dim, 0.5), np.zeros((1, 1))
    estimate = point_estimate("fake", space, middle, 0.0, nothing, nothing[None], 1.0)
    estimate = dataclasses.replace(estimate, nuisances=found)
    assert held_out.air_found(estimate, [lift, doubted]) == pytest.approx(np.exp(-0.5))
    assert held_out.air_found(estimate, [lift]) == 1.0  # as of a wind, whose speed was in doubt
    silent = dataclasses.replace(estimate, nuisances=())  # as of cma-es, which reports none
    assert held_out.air_found(silent, [doubted]) == 1.0
    assert "in air 0.61 times" in HeldOut("fling", 4e-3, (8e-3,), 0, 8e-3, np.exp(-0.5)).describe()


def test_a_run_that_diverged_is_no_better_than_anything():
    assert not HeldOut("fling", float("inf"), (1e-2,), 0, 1e-2).is_better
    assert not HeldOut("fling", 1e-3, (), 8, 1e-2).is_better
    for lost in (HeldOut("fling", float("inf"), (1e-2,), 0, 1e-2), HeldOut("f", 1e-3, (), 8, 1e-2)):
        assert lost.describe().startswith("warning")
    assert "diverged" in HeldOut("fling", float("inf"), (1e-2,), 0, 1e-2).describe()
    nothing_else = HeldOut("fling", 4e-3, (8e-3, 12e-3), 0, float("inf"))
    assert nothing_else.is_better and "prior mean unknown" in nothing_else.describe()


def test_the_line_says_better_or_warns():
    good = HeldOut("fling", 4e-3, (8e-3, 12e-3), 1, 9e-3).describe()
    assert good == (
        "held-out motion fling: mean distance 4 mm; prior mean 9 mm; prior samples 10 mm on "
        "average (8 mm to 12 mm, 2 samples, 1 more diverged): better than the prior mean and every "
        "sample"
    )
    apart = (8e-3, 12e-3)
    assert HeldOut("fling", 9e-3, apart, 0, 1e-2).describe().endswith("the average sample")
    assert HeldOut("fling", 11e-3, apart, 0, 2e-2).describe().startswith("warning: held-out")


def test_an_estimate_that_is_worse_than_the_best_guess_by_the_weight_has_learnt_nothing():
    """The draws scatter about the middle of the prior, which is nearer than most of them."""
    found = HeldOut("fling", 16e-3, (10e-3, 48e-3), 0, 8.5e-3)
    assert not found.is_better and found.describe().startswith("warning")
    assert "not better than the prior mean, so" in found.describe()


def test_a_motion_in_which_all_fabrics_are_alike_tells_nothing():
    """But that an estimate which is far from all of them is wrong, or far better."""
    fold = (2.4e-3, 2.6e-3)
    for error in (2.0e-3, 3.1e-3):
        words = HeldOut("fold", error, fold, 0, 2.5e-3).describe()
        assert not words.startswith("warning") and "no verdict" in words
    assert HeldOut("fold", 9e-3, fold, 0, 2.5e-3).describe().startswith("warning")
    assert HeldOut("fold", 1e-3, fold, 0, 2.5e-3).describe().endswith("and every sample")
    apart = HeldOut("fold", 2.4e-3, fold, 0, 9e-3)  # the middle is another fabric, too
    assert apart.is_discriminating and apart.is_better
