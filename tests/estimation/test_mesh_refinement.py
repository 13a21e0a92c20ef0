"""Estimates by meshes: when a finer one is used, and whether other searches confirm the end."""

import dataclasses

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import PLACE, SMALL, SPACE, end_at, lift_of, problem, short_problem, valley

from r2s.estimation import mesh_refinement
from r2s.estimation.checkpoint import forget
from r2s.estimation.descent import DEFAULT, Diverged, Run, Search, has_arrived, is_stuck, leads_to
from r2s.estimation.estimate import as_json, from_json, point_estimate
from r2s.estimation.gauss_newton import normal_from
from r2s.estimation.mesh_refinement import ALIKE, LIKELY, look_again
from r2s.estimation.methods import DiffCloud
from r2s.estimation.prediction import derivatives_at, theta_length
from r2s.estimation.summary import describe
from r2s.materials.parameters import InformedSpace
from r2s.scenarios import resolution


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize(("enough", "shape"), [(1e9, (3, 3)), (1e-9, (5, 5))])
def test_a_finer_mesh_is_taken_where_the_coarse_one_is_not_enough(enough, shape, monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", enough)
    # the frames all at once lead to 36 N/m, which says that it is not sure
    budget = SMALL._replace(max_iterations=12, frame_fractions=DEFAULT.frame_fractions)
    found = DiffCloud().estimate([lift_of()], SPACE, budget, key=jr.key(0))
    assert found.shape == shape and not found.unsure
    assert found.mesh_bias is not None and np.all(found.standard_errors >= found.mesh_bias)
    truth = float(SPACE.values(PLACE)[0])
    if shape == (5, 5):  # the mesh of the truth
        assert found.values[0] == pytest.approx(truth, rel=0.1)
    else:
        assert found.standard_errors[0] > 0.05
    assert abs(np.log(found.values[0] / truth)) < 2 * found.standard_errors[0]


@pytest.mark.slow(group="estimates")
def test_an_estimate_on_the_finest_mesh_stays_at_its_end_within_what_is_known(monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    known, off = 0.1, 0.02
    prior = InformedSpace.make(SPACE, PLACE + off, jnp.eye(2) / known**2)
    both, budget = [lift_of(), lift_of()], SMALL._replace(num_probes=2)
    found = DiffCloud().estimate(both, prior, budget, key=jr.key(0))
    assert found.shape == (5, 5)
    assert found.reached is not None  # on the mesh before
    errors = found.standard_errors / [bound.width for bound in SPACE.ranges]
    place = np.asarray(SPACE.to_unit(found.fabric))
    # it stays where the loss is least; the way to the prior's mean is part of the errors
    assert np.all(errors < np.hypot(known, np.abs(place - PLACE - off)))
    assert np.all(np.abs(place - PLACE) < 2 * errors)
    assert found.values[0] == pytest.approx(float(SPACE.values(PLACE)[0]), rel=0.1)
    np.testing.assert_allclose(found.shares, 0.5, rtol=1e-6)  # of recordings that are the same
    assert found.agreement is None or found.agreement.contradiction is None


def test_meshes_of_a_taut_sheet_are_coarser_and_the_estimate_has_that_of_the_others():
    free = lift_of()
    taut = dataclasses.replace(free, info=dataclasses.replace(free.info, scenario="stretching"))

    def longest(*recordings):
        return [max(map(max, level)) for level in mesh_refinement._levels(recordings)]

    assert longest(free) == [17, 33] and longest(taut) == [9, 17]
    assert longest(free, taut) == [9, 17, 33] and longest(taut, taut) == [9, 17, 17]
    assert mesh_refinement._named([free, taut], ((33, 33), (17, 17))) == (33, 33)
    assert mesh_refinement._named([taut, free], ((17, 17), (33, 33))) == (33, 33)
    assert mesh_refinement._named([taut], ((17, 5),)) == (17, 5)


@pytest.mark.slow(group="estimates")
def test_where_all_diverges_on_a_finer_mesh_the_estimate_is_of_the_coarser_and_says_so(monkeypatch):
    searched: list[tuple[int, bool]] = []

    def search(problems, run, **_):
        searched.append((len(problems[0].scenario.scene.mesh.rest), run.budget.is_intermediate))
        if searched[-1][0] == 25:
            raise Diverged("all starts of the descents diverged")
        return Search(problems, [[end_at(np.zeros(theta_length(problems)), 1.0)]], 0.0)

    nothing = point_estimate("none", SPACE, PLACE, 0.0, np.zeros((1, 1)), np.zeros((1, 1, 2)), 0.0)
    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    monkeypatch.setattr(mesh_refinement, "look_again", lambda search, *_: search)
    monkeypatch.setattr(mesh_refinement, "with_uncertainty", lambda *_, **__: nothing)
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    found = DiffCloud().estimate([lift_of()], SPACE, SMALL, key=jr.key(0))
    assert searched == [(9, True), (9, False), (25, False)]
    assert found.shape == (3, 3)
    assert found.refused.startswith("5 x 5 vertices") and "diverged" in found.refused
    assert from_json(as_json(found)).refused == found.refused
    with pytest.raises(RuntimeError, match="diverged"):  # the finest was asked for
        DiffCloud(finest=True).estimate([lift_of()], SPACE, SMALL, key=jr.key(0))


@pytest.mark.slow(group="estimates")
def test_a_recording_of_twice_the_weight_counts_as_two():
    stiff, soft = problem(1.5), problem(0.7)
    theta = jnp.zeros(theta_length((stiff, soft))).at[:2].set(PLACE)
    predicted = derivatives_at((stiff, soft), theta)
    pairs = zip((stiff, soft), (6.0, 3.0), strict=True)
    twice = tuple(dataclasses.replace(each, weight=jnp.array(count)) for each, count in pairs)
    weighed = normal_from(twice, theta, predicted, jnp.zeros(()))
    all_three = (stiff, stiff, soft)
    longer = jnp.zeros(theta_length(all_three)).at[:2].set(PLACE)
    counted = normal_from(all_three, longer, [predicted[0], *predicted], jnp.zeros(()))
    alike = normal_from((stiff, soft), theta, predicted, jnp.zeros(()))
    np.testing.assert_allclose(weighed.loss, counted.loss, rtol=1e-6)
    np.testing.assert_allclose(weighed.gradient[:2], counted.gradient[:2], rtol=1e-5)
    np.testing.assert_allclose(weighed.matrix[:2, :2], counted.matrix[:2, :2], rtol=1e-5)
    assert weighed.spread == pytest.approx(float(counted.spread), rel=1e-6)
    assert abs(float(alike.loss / weighed.loss) - 1) > 0.01
    assert float(weighed.widest) == pytest.approx(float(alike.widest))


def test_recordings_count_by_what_is_left_of_them_alone_and_none_is_exact():
    ends = [end_at(np.zeros(3), loss) for loss in (4e-6, 1e-8, 0.0)]
    cloud, markers, exact = mesh_refinement.weights(ends)
    assert markers / cloud == pytest.approx(400)
    assert exact == pytest.approx(1e10)


@pytest.mark.parametrize(("loss", "words"), [(1.2, "as it was"), (1.3, "5 x 5 vertices fit worse")])
def test_a_finer_mesh_that_fits_worse_is_another_minimum(loss, words, monkeypatch):
    """By one outlier scale; what other searches said of the coarser mesh is kept."""
    other = jnp.zeros(3)

    def level(shape, place, scale):
        row, problems = [end_at(np.full(3, place), scale=scale)], (Stub(),)
        said = (2, 3), "as it was", (other,), (shape,)
        return Search(problems, [row], 0.0, *said)  # pyright: ignore

    run, scales = by_place(monkeypatch)
    search = mesh_refinement._continued(level((3, 3), 1.0, 6e-3), level((5, 5), loss, 15e-3), run)
    assert search.reached == (2, 3) and search.unsure.startswith(words)
    assert search.shapes == ((5, 5),) and search.others == (other,)
    assert scales == pytest.approx([6e-3, 6e-3])


class Stub:
    """What a look asks of a problem."""

    space = SPACE


def ended(place: float, scale: float = 6e-3) -> Search:
    """A search that ended with both numbers at a place."""
    row = [end_at(np.full(SPACE.dim, place), place, scale=scale)]
    return Search((Stub(),), [row], 1.0)  # pyright: ignore


def by_place(monkeypatch) -> tuple[Run, list[float]]:
    """A run in which the loss of an end is its place, and the outlier scales that were asked."""
    scales: list[float] = []

    def loss(_, predicted, scale):
        scales.append(float(scale))
        return float(predicted[0][0])

    monkeypatch.setattr(mesh_refinement, "loss_from", loss)
    monkeypatch.setattr(mesh_refinement, "leads_to", lambda *_: False)
    run = Run(DEFAULT, jr.key(0), lambda _, theta, __: [(theta, None)])  # pyright: ignore
    return run, scales


def looked(monkeypatch, first: Search, *others: Search | None):
    """The look at a first end, where other searches end at others (None: they diverge); the loss of
    an end is its place."""
    left, starts = iter(others), []

    def search(problems, run, *, start, words):
        assert run.budget.num_starts == 1 and not run.budget.num_samples
        assert run.budget.warm_start != run.budget.is_intermediate
        starts.append(np.asarray(start))
        end = next(left)
        if end is None:
            raise Diverged("all starts of the descents diverged")
        return end

    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    run, scales = by_place(monkeypatch)
    return look_again(first, run), starts, scales


def test_two_searches_that_end_alike_are_enough(monkeypatch):
    """By the outlier scale of the best fit."""
    near = 0.6 * (1 + 0.9 * (ALIKE - 1))
    found, starts, scales = looked(monkeypatch, ended(0.6, 9e-3), ended(near, 7e-3))
    np.testing.assert_allclose(scales, 7e-3)
    assert found.reached == (2, 2) and found.seconds == 2.0
    assert float(found.theta[0]) == pytest.approx(0.6)
    assert [float(each[0]) for each in found.others] == pytest.approx([near])  # in its errors
    assert np.max(np.abs(starts[0] - SPACE.prior()[0])) > 0.01  # a draw of the prior


def test_where_two_differ_the_best_of_three_is_taken_and_counted(monkeypatch):
    ends = ended(0.6), ended(0.3), ended(0.3), ended(0.301)  # the last is the best, completed
    found, starts, _ = looked(monkeypatch, *ends)
    assert found.reached == (2, 3) and not found.unsure
    assert float(found.theta[0]) == pytest.approx(0.301)
    assert np.max(np.abs(starts[1] - starts[0])) > 0.01  # not from the same place again
    found, _, _ = looked(monkeypatch, ended(0.3), ended(0.6), None)
    assert found.reached == (1, 3) and float(found.theta[0]) == pytest.approx(0.3)
    assert found.unsure == "none of 2 searches from other starts fits as well"
    assert found.others == ()


def test_a_killed_look_at_other_starts_resumes(monkeypatch, tmp_path):
    """Every search has a checkpoint of its own, which goes when the estimate is finished."""
    files = []

    def search(problems, run, *, start, words):
        files.append(run.checkpoint)
        run.checkpoint.touch()
        return ended(0.3 / len(files))

    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    run = by_place(monkeypatch)[0]._replace(checkpoint=tmp_path / "state.npz")
    look_again(ended(0.6), run, coarse=ended(0.9))
    assert len(files) == 5 == len(set(files))  # two searches on two meshes, and the end of the best
    forget(tmp_path / "state.npz")
    assert not list(tmp_path.iterdir())


def test_a_search_that_leads_to_the_known_end_ends_there():
    """Where the loss is quadratic one Gauss-Newton step leads to its minimum."""
    lifted = short_problem()
    known, at = valley(lifted, theta_length((lifted,)))
    known = dataclasses.replace(known, normal=at(known.theta, loss=1.0))
    place = known.theta.at[:2].add(jnp.array([0.03, -0.02]))

    def near(gradient, loss):
        return dataclasses.replace(known, theta=place, normal=at(place, gradient, loss))

    assert leads_to((lifted,), near(0.0, 1.2), known)
    assert not leads_to((lifted,), near(0.0, 1.3), known)  # it fits worse
    assert not leads_to((lifted,), near(1.0, 1.2), known)  # another minimum
    assert not leads_to((lifted,), near(0.0, jnp.nan), known)
    far = dataclasses.replace(near(0.0, 1.2), theta=known.theta.at[0].add(0.4))
    assert not leads_to((lifted,), far, known)  # a step is shorter than that


def test_a_search_that_leads_to_the_first_end_confirms_it(monkeypatch):
    by_place(monkeypatch)
    first, halfway = ended(0.3), ended(0.36)
    monkeypatch.setattr(mesh_refinement, "multi_start", lambda *_, **__: halfway)
    run = by_place(monkeypatch)[0]
    monkeypatch.setattr(mesh_refinement, "leads_to", lambda _, end, known: known is first.best)
    found = look_again(first, run)
    assert found.reached == (2, 2) and float(found.theta[0]) == pytest.approx(0.3)
    assert found.seconds == 2.0


def test_a_search_that_leads_to_the_known_end_of_a_coarser_mesh_is_not_made_on_the_finer(
    monkeypatch,
):
    by_place(monkeypatch)
    first, coarse, made = ended(0.3), ended(0.4), []

    def search(problems, run, *, start, words):
        made.append(run.known)
        return ended(0.36)

    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    run = by_place(monkeypatch)[0]
    monkeypatch.setattr(mesh_refinement, "leads_to", lambda _, end, known: known is coarse.best)
    found = look_again(first, run, coarse)
    assert found.reached == (2, 2) and float(found.theta[0]) == pytest.approx(0.3)
    assert made == [coarse.best]


def test_an_end_that_fits_nearly_as_well_is_in_the_errors_though_it_confirms_nothing(monkeypatch):
    ends = ended(0.3), ended(0.3 * 0.99 * LIKELY), ended(0.3 * 1.01 * LIKELY)
    found, *_ = looked(monkeypatch, *ends)
    assert found.reached == (1, 3)
    assert [float(each[0]) for each in found.others] == pytest.approx([0.297 * LIKELY])


@pytest.mark.parametrize(("gain", "expected"), [(0.01, False), (1e-5, True)])
def test_a_search_whose_last_steps_still_gain_has_not_arrived(gain, expected):
    """Nor where an earlier stage, of fewer frames, would have been content."""
    problems = (problem(1.0),)
    size = theta_length(problems)
    rows = [
        [end_at(np.full(size, 0.5 + 0.01 * i), (1 - gain) ** i, gradient=1.0, matrix=np.eye(size))]
        for i in range(6)
    ]
    assert has_arrived(Search(problems, rows, 0.0)) == expected


@pytest.mark.parametrize(("slope", "damping", "expected"), [(0, 40, 0), (1, 40, 1), (1, 0.1, 0)])
def test_a_descent_is_stuck_where_no_step_lowers_the_loss_and_the_end_is_far(
    slope, damping, expected
):
    problems = (problem(1.0),)
    size = theta_length(problems)
    matrix = 1e-2 * np.eye(size)
    end = end_at(np.full(size, 0.5), 1e-6, gradient=1e-3 * slope, matrix=matrix)
    end = dataclasses.replace(end, damping=jnp.asarray(float(damping)))
    assert is_stuck(Search(problems, [[end]], 0.0)) == expected


def test_an_estimate_says_how_many_searches_ended_there():
    place, none = jnp.full(SPACE.dim, 0.5), np.zeros((1, 1))
    for unsure, words in (("", "2 of 2 searches"), ("why", "not sure of the minimum: why")):
        found = point_estimate("any", SPACE, place, 0.0, none, none[None], 0.0, converged=True)
        found = dataclasses.replace(found, reached=(2, 2), unsure=unsure)
        assert any(line.startswith("search") and words in line for line in describe(found))
        again = from_json(as_json(found))
        assert again.reached == (2, 2) and again.unsure == unsure


def test_a_shape_and_the_finest_mesh_exclude_each_other():
    with pytest.raises(ValueError, match="leave it out"):
        DiffCloud(finest=True, shape=(9, 9)).estimate([lift_of()], SPACE, key=jr.key(0))
