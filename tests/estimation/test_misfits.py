"""What of a recording does not fit a fabric is found and named, and nothing else is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s import scenarios
from r2s.cli import estimate_report
from r2s.estimation.consistency import asks_for_density, misfits, with_free_density
from r2s.estimation.estimate import Agreement, Contradiction, Estimate, Misfit, point_estimate
from r2s.estimation.methods import DiffCloud
from r2s.estimation.prediction import fabric_at, predict, theta_length
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.recording import make_recording
from r2s.scenarios import synthetic

SHAPE = (5, 5)
KNIT = presets.grey_interlock()
SPACE = OrthotropicSpace.make(float(KNIT.density))
STRICT = 0.01  # [m], beyond which points do not count


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


def test_what_fits_is_not_named(pulled, lifted):
    for recording in (pulled, lifted):
        problem = problem_of(recording)
        theta, seen = at_truth(problem)
        assert misfits((problem,), theta, seen) == ()
        (share,) = outlier_fractions((problem,), seen, STRICT)
        assert share < 0.01


def test_a_marker_on_another_cloth_is_named(pulled):
    away = jnp.asarray(pulled.markers).at[1:, 2].add(jnp.array([0.0, 0.03, 0.02]))
    problem = problem_of(dataclasses.replace(pulled, markers=away))
    theta, seen = at_truth(problem)
    (found,) = misfits((problem,), theta, seen)
    assert (found.recording, found.what, found.unit) == (0, "marker 2", "m")
    assert found.off == pytest.approx(np.hypot(0.03, 0.02), abs=2e-3)
    count = pulled.markers.shape[1]
    (share,) = outlier_fractions((problem,), seen, STRICT)
    assert share == pytest.approx(1 / count, abs=0.02)


def test_a_marker_that_stays_behind_or_is_lost_on_the_way_is_named(pulled):
    """One that hardly moves in a pull of millimetres, and one that jumps near the end."""
    seen_at = np.array(pulled.markers)
    moved = np.linalg.norm(seen_at[-1] - seen_at[0], axis=1)
    still = int(np.argmin(np.abs(moved - 5e-3)))
    behind, lost = seen_at.copy(), seen_at.copy()
    behind[:, still] = seen_at[:1, still]
    lost[int(0.7 * len(lost)) :, 3] += [0.0, 0.05, 0.05]
    for markers, which in ((behind, still), (lost, 3)):
        problem = problem_of(dataclasses.replace(pulled, markers=jnp.asarray(markers)))
        theta, seen = at_truth(problem)
        (found,) = misfits((problem,), theta, seen)
        assert found.what == f"marker {which}" and found.off > 2e-3


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
    assert not asks_for_density(both, None, [bent]) and not asks_for_density(
        both, Agreement(0.3, (3, 3), None), []
    )
    assert not asks_for_density(
        both[1:], None, [missed]
    )  # a pull alone has no other weight to go by
    assert not asks_for_density(both[:1] * 2, odd, [])  # nothing weighs the sheet


def test_a_density_that_is_freed_is_the_one_that_was_found(pulled):
    """A theta in which it is half a standard deviation of 10 % heavier stays as heavy."""
    prior = NuisancePrior(density=0.1)
    problem = Problem.make(pulled, SPACE, shape=SHAPE, nuisance_prior=prior)
    theta, _ = at_truth(problem)
    (loose,), there = with_free_density((problem,), theta.at[SPACE.dim].set(0.5))
    density = float(fabric_at(loose, there).density)
    assert density == pytest.approx(float(KNIT.density) * np.exp(0.05), rel=1e-5)


def test_points_of_another_thing_are_counted(lifted):
    mask = np.asarray(lifted.mask)
    points = np.array(lifted.points)
    points[:, ::5, 2] += 0.3
    problem = problem_of(dataclasses.replace(lifted, points=jnp.asarray(points)))
    _, seen = at_truth(problem)
    (share,) = outlier_fractions((problem,), seen, STRICT)
    assert share == pytest.approx(mask[:, ::5].sum() / mask.sum(), abs=0.05)


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
        left_out=(0.02, 0.76),
    )
    lines = [*estimate_report.misfits(found, [pulled, lifted])]
    assert "pull" in lines[0] and "marker 2 is 36 mm" in lines[0]
    assert "lift" in lines[1] and "the density" in lines[1]
    assert "pull" in lines[2] and "off by 250 %" in lines[2] and "density" in lines[2]
    assert lines[3] == f"left out of {pulled.info.name}: 2.0 % as outliers"
    assert lines[4].startswith("warning") and "76.0 %" in lines[4] and "density" in lines[4]


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
    assert most > 300 and f"all but 300 points a frame, drawn at random, of up to {most}" in line
    few = dataclasses.replace(lifted, points=lifted.points[:, :200], mask=lifted.mask[:, :200])
    assert not list(estimate_report.unread(DiffCloud(), [few]))


def test_clouds_that_nobody_recorded_are_not_left_unread(pulled):
    """Markers stand in their place."""
    bare = make_recording(
        None,
        pulled.times,
        pulled.handle_path,
        pulled.handle_times,
        pulled.info,
        markers=pulled.markers,
        marker_places=pulled.marker_places,
    )
    assert not list(estimate_report.unread(DiffCloud(), [bare]))
