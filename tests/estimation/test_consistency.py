"""Recordings of two fabrics contradict each other, and what does not fit an estimate is named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from r2s import scenarios
from r2s.cli import estimate_report
from r2s.estimation.consistency import (
    MOST,
    UNLIKELY,
    Information,
    agreement,
    asks_for_density,
    by_slopes,
    density_of,
    fits,
    information_of,
    is_sure,
    misfits,
    outlier,
    scatter_of,
)
from r2s.estimation.descent import DEFAULT, Run, each_alone
from r2s.estimation.estimate import Agreement, Contradiction, Estimate, Fit, Misfit, point_estimate
from r2s.estimation.methods import DiffCloud
from r2s.estimation.prediction import (
    derivatives_at,
    predict,
    remembering,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.estimation.standard_errors import _smooth_pulls
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

SHAPE = (5, 5)
KNIT = presets.grey_interlock()
SPACE = OrthotropicSpace.make(float(KNIT.density))
STRICT = 0.01  # [m], beyond which points do not count


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


def ends_of(problems, place):
    theta = jnp.zeros(theta_length(problems), float).at[: len(place)].set(place)
    return each_alone(problems, Run(DEFAULT, jax.random.key(0), remembering()), theta, "alone")


def judged(problems, place):
    return agreement(problems, ends_of(problems, place))


def stepped(problems, place):
    """The agreement by the slopes of each a place that is right for the first."""
    theta = jnp.zeros(theta_length(problems), float).at[: len(place)].set(place)
    predicted, ends = derivatives_at(problems, theta), []
    for which, problem in enumerate(problems):
        own = theta[theta_indices(problems, which)]
        ends.append(by_slopes(problem, own, [predicted[which]], jnp.asarray(STRICT)))
    return agreement(problems, ends)


@pytest.mark.slow(group="estimates")
def test_recordings_of_one_fabric_agree_and_that_of_another_is_named(lifts):
    first, second, other, place = lifts
    assert judged((first,), place) is None
    agreed = judged((first, second), place)
    assert agreed is not None and agreed.contradiction is None and min(agreed.determined) > 2
    apart = judged((first, other, second), place)
    assert apart is not None and apart.p < 1e-6
    odd = apart.contradiction
    assert odd is not None and odd.recording == 1
    assert odd.parameter in ("warp", "weft", "shear") and odd.errors > 3
    assert odd.values[0] == pytest.approx(3 * odd.values[1], rel=0.3)
    # slopes see that there is nothing to look for, or that there is
    by_steps = stepped((first, second), place), stepped((first, other, second), place)
    assert all(each is not None for each in by_steps)
    assert [is_sure(each) for each in by_steps if each is not None] == [True, False]


@pytest.mark.slow(group="estimates")
def test_a_recording_is_excused_by_the_error_of_its_own_mesh_alone(lifts):
    """Whatever the signs of that error, which are not known."""
    first, _, other, place = lifts
    pair = first, other
    ends = ends_of(pair, place)
    none, far = np.zeros(len(place)), np.full(len(place), MOST)
    signs = (-1) ** np.arange(len(place))
    cases = (), [none, far], [none, -far * signs], [none, far / 100], [far, far]
    alone, excused, opposite, hardly, both = (agreement(pair, ends, biases) for biases in cases)
    assert alone is not None and excused is not None and opposite is not None
    assert excused.p == opposite.p > alone.p == excused.exact and alone.exact is None
    assert hardly is not None and hardly.contradiction is not None
    # three times as stiff is within the errors of two of the worst meshes
    assert both is not None and both.contradiction is None
    assert both.exact == alone.p < UNLIKELY < both.p


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


def test_p_values_of_one_fabric_are_uniform_and_those_of_an_outlier_small():
    chances = _chances(0.0)
    for level in (0.1, 0.5):
        assert np.mean(chances < level) == pytest.approx(level, abs=0.06)
    assert np.mean(chances < 0.01) < 0.03
    assert np.mean(_chances(10.0) < 1e-4) > 0.4 and np.mean(_chances(20.0) < 1e-4) > 0.8


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


def problem_of(recording) -> Problem:
    return Problem.make(recording, SPACE, shape=SHAPE)


def estimate_with(**fields) -> Estimate:
    """An estimate in the middle of the space."""
    none = np.zeros(0)
    made = point_estimate("diffcloud", SPACE, jnp.full(SPACE.dim, 0.5), 0.0, none, none, 0.0)
    return dataclasses.replace(made, **fields)


def at_truth(problem):
    """Theta of the true fabric, and what is seen of it."""
    theta = jnp.zeros(theta_length((problem,)), float).at[: SPACE.dim].set(SPACE.to_unit(KNIT))
    return theta, [jax.jit(predict)(problem, theta)]


@pytest.fixture(scope="module")
def pulled():
    """A stretching with markers."""
    experiment = scenarios.stretching()
    return synthetic.record(experiment, KNIT, "pull", shape=SHAPE, key=jax.random.key(0))


@pytest.fixture(scope="module")
def lifted():
    """A lift with clouds."""
    experiment = scenarios.lifting(num_frames=16, interval=0.18)
    return synthetic.record(experiment, KNIT, "lift", shape=SHAPE, key=jax.random.key(0))


@pytest.mark.slow(group="estimates")
def test_what_fits_is_not_named_and_points_of_another_thing_are_counted(pulled, lifted):
    for recording in (pulled, lifted):
        problem = problem_of(recording)
        theta, seen = at_truth(problem)
        assert misfits((problem,), theta, seen) == ()
        (fit,) = fits((problem,), seen, STRICT)
        assert fit.outliers < 0.01 and fit.distance < 2e-3
    mask, points = np.asarray(lifted.mask), np.array(lifted.points)
    points[:, ::5, 2] += 0.3
    problem = problem_of(dataclasses.replace(lifted, points=jnp.asarray(points)))
    (fit,) = fits((problem,), at_truth(problem)[1], STRICT)
    assert fit.outliers == pytest.approx(mask[:, ::5].sum() / mask.sum(), abs=0.05)


def test_a_pull_changes_in_proportion_within_its_errors(pulled):
    """So that places around the end of an estimate need no motions of pulls."""
    problems = (problem_of(pulled),)
    theta, _ = at_truth(problems[0])
    there = derivatives_at(problems, theta)
    place = theta.at[: SPACE.dim].add(0.01 * jnp.array([1.0, -1, 1, -1, 1, -1, 1]))
    ((exact, _),) = derivatives_at(problems, place)
    ((near, slope),) = _smooth_pulls(theta, there)(problems, place, None)
    assert slope is there[0][1]
    for name in ("x", "force"):
        before, moved, said = (np.asarray(getattr(p, name)) for p in (there[0][0], exact, near))
        change = np.linalg.norm(moved - before)
        assert change > 0 and np.linalg.norm(said - moved) < 0.1 * change


def test_a_marker_on_another_cloth_or_lost_by_the_tracker_is_named(pulled):
    """One that is elsewhere, one that hardly moves, and one that jumps near the end."""
    markers = np.array(pulled.markers)
    still = int(np.argmin(np.abs(np.linalg.norm(markers[-1] - markers[0], axis=1) - 5e-3)))
    elsewhere, behind, lost = markers.copy(), markers.copy(), markers.copy()
    elsewhere[1:, 2] += [0.0, 0.03, 0.02]
    behind[:, still] = markers[:1, still]
    lost[int(0.7 * len(lost)) :, 3] += [0.0, 0.05, 0.05]
    for changed, which in ((elsewhere, 2), (behind, still), (lost, 3)):
        problem = problem_of(dataclasses.replace(pulled, markers=jnp.asarray(changed)))
        theta, seen = at_truth(problem)
        (stray,) = misfits((problem,), theta, seen)
        assert stray[:2] == (0, f"marker {which}") and stray.unit == "m" and stray.off > 2e-3
        if which == 2:
            assert stray.off == pytest.approx(np.hypot(0.03, 0.02), abs=2e-3)
            (fit,) = fits((problem,), seen, STRICT)
            assert fit.outliers == pytest.approx(1 / markers.shape[1], abs=0.02)


def test_a_force_of_another_sheet_is_named(pulled):
    """In other units, say; one that is off by a tenth is not."""
    for factor, expected in ((1.1, 0.1), (2.0, 0.5), (0.1, 9.0)):
        problem = problem_of(dataclasses.replace(pulled, force=factor * jnp.asarray(pulled.force)))
        theta, seen = at_truth(problem)
        found = misfits((problem,), theta, seen)
        assert bool(found) == (expected > 1 / 3)
        if found:
            assert (found[0].what, found[0].unit) == ("force", "of its size")
            assert found[0].off == pytest.approx(expected, rel=0.15)


def test_a_density_is_asked_for_where_a_force_is_missed_or_recordings_are_apart(pulled, lifted):
    both = problem_of(lifted), problem_of(pulled)
    missed, bent = Misfit(1, "force", 2.0, "of its size"), Misfit(1, "shift x", 4.0, "")
    odd = Agreement(1e-9, (3, 3), Contradiction(1, "warp", 9.0, (1.0, 2.0)))
    assert asks_for_density(both, None, [missed]) and asks_for_density(both, odd, [])
    assert not asks_for_density(both, None, [bent])
    assert not asks_for_density(both, Agreement(0.3, (3, 3), None), [])
    assert not asks_for_density(both[1:], None, [missed])  # a pull alone
    assert not asks_for_density(both[:1] * 2, odd, [])  # no force


def test_what_was_written_down_and_does_not_fit_is_named(lifted):
    problem = problem_of(lifted)
    theta, seen = at_truth(problem)
    first = SPACE.dim + 3  # the shift along x, after what recordings share
    (found,) = misfits((problem,), theta.at[first].set(-4.0), seen)
    assert found == (0, "shift x", 4.0, "standard deviations")
    # what is exact is not told, whatever its number
    assert misfits((problem,), theta.at[SPACE.dim].set(9.0), seen) == ()


def test_the_command_says_so(lifted, pulled):
    found = estimate_with(
        misfits=(
            Misfit(0, "marker 2", 0.036, "m"),
            Misfit(1, "air", 5.0, "standard deviations"),
            Misfit(0, "force", 2.5, "of its size"),
        ),
        fits=(Fit("pull", 1e-3, 0.02), Fit("lift", 9e-3, 0.76)),
    )
    lines = [*estimate_report.misfits(found, [pulled, lifted])]
    assert "pull" in lines[0] and "marker 2 is 36 mm" in lines[0]
    assert "lift" in lines[1] and "the density" in lines[1]
    assert "pull" in lines[2] and "off by 250 %" in lines[2] and "density" in lines[2]
    (last,) = lines[3:]
    assert last.startswith("warning: 76 % of lift are outliers") and "density" in last


@pytest.mark.parametrize("is_coarse", [False, True])
def test_a_mesh_that_is_too_coarse_is_named_where_recordings_are_apart(is_coarse, pulled, lifted):
    """In wind a coarse sheet leads far from what it leads to elsewhere."""
    odd = Agreement(1e-9, (3, 3), Contradiction(1, "warp", 9.0, (1.0, 2.0)))
    found = estimate_with(agreement=odd)
    (line,) = estimate_report.agreement(found, [pulled, lifted], is_coarse)
    assert line.startswith(f"warning: {lifted.info.name} contradicts")
    assert ("or the mesh" in line) is is_coarse


def test_points_that_are_not_read_are_counted(lifted):
    most = int(lifted.mask.sum(axis=1).max())
    (line,) = estimate_report.unread(DiffCloud(), [lifted])
    assert most > 300 and f"beyond 300 a frame, drawn at random (up to {most} are there)" in line
    few = dataclasses.replace(lifted, points=lifted.points[:, :200], mask=lifted.mask[:, :200])
    assert not list(estimate_report.unread(DiffCloud(), [few]))
