"""Estimates by meshes: when a finer one is used, and whether other searches confirm the end."""

import dataclasses

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from known_ends import PLACE, SMALL, SPACE, lift_of, problem

from r2s.estimation import descent, mesh_refinement
from r2s.estimation.descent import DEFAULT, Search
from r2s.estimation.estimate import as_json, from_json, point_estimate
from r2s.estimation.gauss_newton import Descent, Normal, normal_from
from r2s.estimation.mesh_refinement import ALIKE, LIKELY, look_again
from r2s.estimation.methods import DiffCloud
from r2s.estimation.prediction import derivatives_at, theta_length
from r2s.estimation.summary import describe
from r2s.materials.parameters import InformedSpace
from r2s.scenarios import resolution


def of_loss(loss: float, size: int = 3) -> Descent:
    """The end of a descent of which the loss alone matters."""
    none, theta, square = jnp.zeros(()), jnp.zeros(size), jnp.zeros((size, size))
    normal = Normal(jnp.asarray(loss), none, none, theta, square, square)
    return Descent(theta, normal, none, none, none, jnp.zeros((), int))


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize(("enough", "shape"), [(1e9, (3, 3)), (1e-9, (5, 5))])
def test_a_finer_mesh_is_taken_where_the_coarse_one_is_not_enough(enough, shape, monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", enough)
    # the frames all at once lead to 36 N/m, which says that it is not sure
    budget = SMALL._replace(max_iterations=12, frame_fractions=DEFAULT.frame_fractions)
    found = mesh_refinement.descend_by_meshes([lift_of()], SPACE, budget, key=jr.key(0))
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
    found = mesh_refinement.descend_by_meshes(both, prior, budget, key=jr.key(0))
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


@pytest.mark.slow(group="estimates")
def test_an_estimate_is_named_by_the_mesh_of_what_moves_freely():
    """Whichever recording comes first: a pull has a coarser one on the last rung."""
    free = lift_of()
    taut = dataclasses.replace(free, info=dataclasses.replace(free.info, scenario="stretching"))
    assert mesh_refinement._named([free, taut], [(33, 33), (17, 17)]) == (33, 33)
    assert mesh_refinement._named([taut, free], [(17, 17), (33, 33)]) == (33, 33)
    assert mesh_refinement._named([taut], [(17, 5)]) == (17, 5)


@pytest.mark.slow(group="estimates")
def test_one_recording_of_a_taut_sheet_is_searched_on_the_coarsest_mesh_and_others_are_not():
    free = lift_of()
    taut = dataclasses.replace(free, info=dataclasses.replace(free.info, scenario="stretching"))

    def longest(*recordings):
        return [max(map(max, rung)) for rung in mesh_refinement._levels(recordings)]

    assert longest(free) == [17, 33] and longest(taut) == [9, 17]
    assert longest(free, taut) == [9, 17, 33] and longest(taut, taut) == [9, 17, 17]


@pytest.mark.slow(group="estimates")
def test_a_shape_that_is_asked_for_is_kept(monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    found = mesh_refinement.descend_by_meshes(
        [lift_of()], SPACE, SMALL, shape=(3, 3), key=jr.key(0)
    )
    assert found.shape == (3, 3)


@pytest.mark.slow(group="estimates")
def test_where_all_diverges_on_a_finer_mesh_the_estimate_is_of_the_coarser_and_says_so(monkeypatch):
    searched: list[tuple[int, bool]] = []

    def search(problems, budget, **_):
        searched.append((len(problems[0].scenario.scene.mesh.rest), budget.is_intermediate))
        if searched[-1][0] == 25:
            raise RuntimeError("all starts of the descents diverged")
        end = of_loss(1.0, theta_length(problems))
        return Search(problems, [[end]], 0.0, derivatives_at)

    nothing = point_estimate("none", SPACE, PLACE, 0.0, np.zeros((1, 1)), np.zeros((1, 1, 2)), 0.0)
    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    monkeypatch.setattr(mesh_refinement, "look_again", lambda found, *_, **__: found)
    monkeypatch.setattr(mesh_refinement, "with_uncertainty", lambda *_, **__: nothing)
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    found = mesh_refinement.descend_by_meshes([lift_of()], SPACE, SMALL, key=jr.key(0))
    assert searched == [(9, True), (9, False), (25, False)]
    assert found.shape == (3, 3)
    assert found.refused.startswith("5 x 5 vertices") and "diverged" in found.refused
    assert from_json(as_json(found)).refused == found.refused
    with pytest.raises(RuntimeError, match="diverged"):  # the finest was asked for
        mesh_refinement.descend_by_meshes([lift_of()], SPACE, SMALL, finest=True, key=jr.key(0))


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
    ends = [of_loss(loss) for loss in (4e-6, 1e-8, 0.0)]
    cloud, markers, exact = mesh_refinement.weights(ends)
    assert markers / cloud == pytest.approx(400)
    assert exact == pytest.approx(1e10)


@pytest.mark.parametrize(("loss", "words"), [(1.2, "as it was"), (1.3, "5 x 5 vertices fit worse")])
def test_a_finer_mesh_that_fits_worse_is_another_minimum(loss, words):
    def rung(shape, loss):
        found = descent.Search((), [[of_loss(loss)]], 0.0, derivatives_at, (2, 3), "as it was")
        return mesh_refinement.Level([shape], found)

    at = mesh_refinement._went_on(rung((3, 3), 1.0), rung((5, 5), loss))
    assert at.found.reached == (2, 3) and at.found.unsure.startswith(words)
    assert at.shapes == [(5, 5)]


class Stub:
    """What a look asks of a problem."""

    space = SPACE


def ended(place: float, scale: float = 6e-3) -> Search:
    """A search that ended with both numbers at a place."""
    none, size = jnp.zeros(()), SPACE.dim
    theta, square = jnp.full(size, place), jnp.eye(size)
    normal = Normal(none, none, none, theta, square, square)
    row = [Descent(theta, normal, none, none, jnp.asarray(scale), jnp.zeros((), int))]
    return Search((Stub(),), [row], 1.0, lambda _, theta, __: [(theta, None)])  # pyright: ignore


def looked(monkeypatch, first: Search, *others: Search | None, losses):
    """The look at a first end, where other searches end at others (None: they diverge)."""
    left, starts, scales = iter(others), [], []

    def search(problems, budget, *, start, **_):
        assert (
            budget.num_starts == 1
            and not budget.num_samples
            and budget.warm_start != budget.is_intermediate
        )
        starts.append(np.asarray(start))
        found = next(left)
        if found is None:
            raise RuntimeError("all starts of the descents diverged")
        return found

    def loss(_, predicted, scale):
        scales.append(float(scale))
        return losses(float(predicted[0][0]))

    monkeypatch.setattr(mesh_refinement, "multi_start", search)
    monkeypatch.setattr(mesh_refinement, "loss_from", loss)
    return look_again(first, DEFAULT, key=jr.key(0)), starts, scales


def test_two_searches_that_end_alike_are_enough(monkeypatch):
    near = 0.6 * (1 + 0.9 * (ALIKE - 1))
    found, starts, _ = looked(monkeypatch, ended(0.6), ended(near), losses=lambda at: at)
    assert found.reached == (2, 2) and found.seconds == 2.0
    assert float(found.theta[0]) == pytest.approx(0.6)
    assert [float(each[0]) for each in found.others] == pytest.approx([near])  # in its errors
    assert np.max(np.abs(starts[0] - SPACE.prior()[0])) > 0.01  # a draw of the prior


def test_where_two_differ_the_best_of_three_is_taken_and_counted(monkeypatch):
    ends = ended(0.6), ended(0.3), ended(0.3), ended(0.301)  # the last goes on to the end
    found, starts, _ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (2, 3) and not found.unsure
    assert float(found.theta[0]) == pytest.approx(0.301)
    assert np.max(np.abs(starts[1] - starts[0])) > 0.01  # not from the same place again


def test_a_search_that_no_other_confirms_is_not_sure(monkeypatch):
    ends = ended(0.3), ended(0.6), None
    found, _, _ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (1, 3) and float(found.theta[0]) == pytest.approx(0.3)
    assert found.unsure == "none of 2 searches from other starts fits as well"
    assert found.others == ()


def test_an_end_that_fits_nearly_as_well_is_in_the_errors_though_it_confirms_nothing(monkeypatch):
    ends = ended(0.3), ended(0.3 * 0.99 * LIKELY), ended(0.3 * 1.01 * LIKELY)
    found, *_ = looked(monkeypatch, *ends, losses=lambda at: at)
    assert found.reached == (1, 3)
    assert [float(each[0]) for each in found.others] == pytest.approx([0.297 * LIKELY])


def test_ends_are_compared_by_the_scale_of_the_best_fit(monkeypatch):
    ends = ended(0.6, 9e-3), ended(0.6, 7e-3)
    _, _, scales = looked(monkeypatch, *ends, losses=lambda at: at)
    np.testing.assert_allclose(scales, 7e-3)


@pytest.mark.parametrize(
    ("unsure", "words"),
    [
        ("", "converged; 2 of 2 searches from different starts fit as well"),
        ("why", "not sure of the minimum: why"),
    ],
)
def test_an_estimate_says_how_many_searches_ended_there(unsure, words):
    place, none = jnp.full(SPACE.dim, 0.5), np.zeros((1, 1))
    found = point_estimate("any", SPACE, place, 0.0, none, none[None], 0.0, converged=not unsure)
    found = dataclasses.replace(found, reached=(2, 2), unsure=unsure)
    assert f"search: {words}, 0 s" in describe(found)
    again = from_json(as_json(found))
    assert again.reached == (2, 2) and again.unsure == unsure


def test_a_shape_and_the_finest_mesh_exclude_each_other():
    with pytest.raises(ValueError, match="leave it out"):
        DiffCloud(finest=True, shape=(9, 9)).estimate([lift_of()], SPACE, key=jr.key(0))
