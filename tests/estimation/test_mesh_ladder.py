"""Estimates by meshes: what one owes to its mesh, and when a finer one is taken."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from r2s.estimation.compiled import derivatives_at, normal_from

from r2s import scenarios
from r2s.estimation import descent, judgement, mesh_ladder, standard_errors
from r2s.estimation.estimate import Estimate, as_json, from_json
from r2s.estimation.gauss_newton import Descent, Normal, theta_length
from r2s.estimation.mesh_bias import OtherMesh, factor, mesh_error
from r2s.estimation.method import Budget
from r2s.estimation.methods import DiffCloud
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.informed_space import InformedSpace
from r2s.materials.parameters import IsotropicSpace
from r2s.scenarios import resolution, synthetic

EXACT = NuisancePrior(0.0, 0.0)
SMALL = Budget(coarse=2, starts=1, iterations=4, around=0)
SPACE = IsotropicSpace.make(float(presets.grey_interlock().density))
PLACE = jnp.array([0.5, 0.5])


def lift(stiffer: float = 1.0):
    """A recorded lift of a fabric that is stiffer than that at `PLACE`, without noise."""
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 0.4}
    experiment = scenarios.lifting(num_frames=6, interval=1 / 10, **motion)
    fabric = SPACE(PLACE.at[0].add(np.log(stiffer) / SPACE.ranges[0].width))
    seen = synthetic.WHOLE._replace(points=300)
    return synthetic.record(experiment, fabric, "knit", seen=seen, shape=(5, 5), key=jr.key(0))


def problem(stiffer: float, shape=(5, 5)) -> Problem:
    return Problem.make(lift(stiffer), SPACE, shape=shape, nuisance_prior=EXACT)


def of_loss(loss):
    """The end of a descent whose loss alone matters."""
    none = jnp.zeros(())
    nowhere = Normal(jnp.asarray(loss), none, none, jnp.zeros(3), *jnp.zeros((2, 3, 3)))
    return Descent(jnp.zeros(3), nowhere, none, none, none, jnp.zeros((), int))


NOWHERE = of_loss(1.0)


@pytest.fixture(scope="module")
def end():
    """A descent that stands at the true fabric."""
    problems = (problem(1.0),)
    theta = jnp.zeros(theta_length(problems)).at[:2].set(PLACE)
    (found,) = descent._fresh(problems, SMALL, [theta], 0.0, 0, derivatives_at)
    return problems, found


@pytest.mark.slow(group="estimates")
def test_the_same_mesh_has_no_bias(end):
    problems, found = end
    seen = derivatives_at(problems, found.theta)
    by = mesh_error(problems, OtherMesh(problems, 1.0), found, seen)
    np.testing.assert_allclose(by.bias, 0, atol=1e-9)
    np.testing.assert_allclose(by.covariance, 0, atol=1e-9)


@pytest.mark.slow(group="estimates")
def test_a_mesh_that_moves_like_a_stiffer_fabric_has_the_bias_of_that_stiffness(end):
    problems, found = end
    seen = derivatives_at(problems, found.theta)
    other = OtherMesh((problem(1.05),), 2.0)
    by = mesh_error(problems, other, found, seen)
    assert by.bias[0] * SPACE.ranges[0].width == pytest.approx(2 * np.log(1.05), rel=0.2)
    assert np.linalg.eigvalsh(by.covariance - np.outer(by.bias, by.bias))[0] > -1e-12


@pytest.mark.slow(group="estimates")
def test_a_motion_that_fails_leaves_the_whole_range_in_doubt(end):
    problems, found = end
    seen = derivatives_at(problems, found.theta)
    broken = eqx.tree_at(lambda p: p.scenario.path, problems[0], replace_fn=lambda p: p * jnp.nan)
    by = mesh_error(problems, OtherMesh((broken,), 1.0), found, seen)
    np.testing.assert_allclose(by.bias, 1)
    np.testing.assert_allclose(by.covariance, np.eye(len(by.bias)))


def test_steps_to_finer_and_coarser_meshes_lead_to_the_same_limit():
    """An error c h^p: the step from h to h / 2 and that from h to 2 h, times their factors."""
    order, error = resolution.ORDER, 0.3
    finer = error * (1 - 0.5**order) * factor(0.5)
    coarser = error * (1 - 2.0**order) * factor(2.0)
    assert finer == pytest.approx(error) and coarser == pytest.approx(error)


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize(("enough", "shape"), [(1e9, (3, 3)), (1e-9, (5, 5))])
def test_a_finer_mesh_is_taken_where_the_coarse_one_is_not_enough(enough, shape, monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", enough)
    found = mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, key=jr.key(0))
    assert found.shape == shape
    assert found.mesh_bias is not None and np.all(found.standard_errors >= found.mesh_bias)
    truth = float(SPACE.values(PLACE)[0])
    if shape == (5, 5):  # the mesh of the truth
        assert found.values[0] == pytest.approx(truth, rel=0.1)
    else:
        assert not np.any(found.identifiable)
    assert abs(np.log(found.values[0] / truth)) < 2 * found.standard_errors[0]


@pytest.mark.slow(group="estimates")
def test_an_estimate_on_the_finest_mesh_stays_at_its_end_within_what_is_known(monkeypatch):
    """Of two recordings, to its end: places around it and each alone are on the mesh before."""
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    known, off = 0.1, 0.02
    prior = InformedSpace.make(SPACE, PLACE + off, jnp.eye(2) / known**2)
    both, budget = [lift(), lift()], SMALL._replace(around=2)
    tried: list[tuple[str, int]] = []

    def note(module, name, stands_in=None):
        does = stands_in or getattr(module, name)

        def noting(*given, **words):
            seen = next(each for each in given if isinstance(each, tuple) and each)
            tried.append((name, len(seen[0].scenario.scene.mesh.rest)))
            return does(*given, **words)

        monkeypatch.setattr(module, name, noting)

    note(standard_errors, "normals_at")
    note(judgement, "each_alone")
    note(judgement.mesh_bias, "alone")
    note(judgement, "_with_density", lambda *_, **__: None)
    monkeypatch.setattr(judgement, "agreement", lambda *_: None)
    monkeypatch.setattr(judgement, "asks_for_density", lambda *_: True)
    found = mesh_ladder.descend_by_meshes(both, prior, budget, key=jr.key(0))
    assert found.shape == (5, 5)
    assert tried == [(name, 9) for name in ("normals_at", "each_alone", "alone", "_with_density")]
    assert found.reached is not None  # on the mesh before
    errors = found.standard_errors / [bound.width for bound in SPACE.ranges]
    assert np.all(errors < np.hypot(known, 2 * off))
    assert found.values[0] == pytest.approx(float(SPACE.values(PLACE)[0]), rel=0.1)
    np.testing.assert_allclose(found.shares, 0.5, rtol=1e-6)  # of recordings that are the same


@pytest.mark.slow(group="estimates")
def test_recordings_that_diverge_alone_on_a_coarser_mesh_are_not_compared(monkeypatch):
    class Progress:
        said: list[str] = []
        say = said.append

        def __call__(self, iteration, loss):
            pass

    def diverges(*_):
        raise RuntimeError("all starts of the descents diverged")

    problems = (problem(1.0), problem(1.0))
    theta = jnp.zeros(theta_length(problems)).at[:2].set(PLACE + 0.01)
    row = descent._fresh(problems, SMALL, [theta], 0.0, len(SMALL.shares) + 1, derivatives_at)
    found = descent.Search(problems, [row], 0.0, derivatives_at)
    monkeypatch.setattr(judgement, "each_alone", diverges)
    estimate = judgement.judged(found, SMALL, progress=Progress(), key=jr.key(0))
    assert estimate.agreement is None and estimate.shares == ()
    assert np.all(estimate.standard_errors > 0)
    assert Progress.said == ["a recording alone diverged: not compared"]


@pytest.mark.slow(group="estimates")
def test_an_estimate_is_named_by_the_mesh_of_what_moves_freely():
    """Whichever recording comes first: a pull has a coarser one on the last rung."""
    free = lift()
    taut = dataclasses.replace(free, info=dataclasses.replace(free.info, scenario="stretching"))
    assert mesh_ladder._told([free, taut], [(33, 33), (17, 17)]) == (33, 33)
    assert mesh_ladder._told([taut, free], [(17, 17), (33, 33)]) == (33, 33)
    assert mesh_ladder._told([taut], [(17, 5)]) == (17, 5)


def test_one_recording_of_a_taut_sheet_is_searched_on_the_coarsest_mesh_and_others_are_not():
    free = lift()
    taut = dataclasses.replace(free, info=dataclasses.replace(free.info, scenario="stretching"))

    def longest(*recordings):
        return [max(map(max, rung)) for rung in mesh_ladder._rungs(recordings)]

    assert longest(free) == [17, 33] and longest(taut) == [9, 17]
    assert longest(free, taut) == [9, 17, 33] and longest(taut, taut) == [9, 17, 17]


def test_a_shape_that_is_asked_for_is_kept(monkeypatch):
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    monkeypatch.setattr(resolution, "ENOUGH", 1e-9)
    found = mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, shape=(3, 3), key=jr.key(0))
    assert found.shape == (3, 3)


def test_the_finest_mesh_is_reached_in_one_stride(monkeypatch):
    """From the mesh before, whose fabric would do; and it is no shape that was asked for."""
    climbed, here = [], jnp.zeros(3)

    def searched(problems, budget, *, start=None, **_):
        mesh = problems[0].scenario.scene.mesh
        climbed.append((len(mesh.rest), budget.leads_on, start is None))
        return descent.Search(problems, [], 0.0, derivatives_at)

    monkeypatch.setattr(descent.Search, "theta", here)
    monkeypatch.setattr(descent.Search, "best", NOWHERE)
    monkeypatch.setattr(mesh_ladder, "search", searched)
    monkeypatch.setattr(mesh_ladder, "judged", lambda *_, **__: estimate_of_nothing())
    monkeypatch.setattr(resolution, "LADDER", (3, 5, 9))
    found = mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, finest=True, key=jr.key(0))
    assert climbed == [(25, True, True), (81, False, False)]
    assert found.shape == (9, 9)
    with pytest.raises(ValueError, match="leave it out"):
        DiffCloud(finest=True, shape=(9, 9)).estimate([lift()], SPACE, key=jr.key(0))


@pytest.mark.parametrize(("folds", "meshes"), [("never", [9, 9]), ("at the end", [9, 9, 25])])
def test_a_fabric_that_folds_at_the_end_of_a_coarse_mesh_goes_on(folds, meshes, monkeypatch):
    """On the way it was stiff enough for that mesh, and the end is softer."""
    climbed: list[tuple[int, bool]] = []

    def searched(problems, budget, **_):
        climbed.append((len(problems[0].scenario.scene.mesh.rest), budget.leads_on))
        return descent.Search(problems, [], 0.0, derivatives_at)

    def is_too_coarse(*_):
        return folds == "at the end" and not climbed[-1][1]

    monkeypatch.setattr(descent.Search, "theta", jnp.zeros(3))
    monkeypatch.setattr(descent.Search, "best", NOWHERE)
    monkeypatch.setattr(mesh_ladder, "search", searched)
    monkeypatch.setattr(mesh_ladder, "is_too_coarse", is_too_coarse)
    monkeypatch.setattr(mesh_ladder, "look_again", lambda found, *_, **__: found)
    monkeypatch.setattr(mesh_ladder, "judged", lambda *_, **__: estimate_of_nothing())
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, key=jr.key(0))
    assert [count for count, _ in climbed] == meshes
    assert [leads_on for _, leads_on in climbed] == [True, *[False] * (len(meshes) - 1)]


def test_each_rung_keeps_its_state_in_a_file_of_its_own(monkeypatch, tmp_path):
    """Also after a pull, whose mesh is the same on the last two."""
    kept: list[str] = []

    def searched(problems, budget, *, checkpoint, **_):
        kept.append(checkpoint.name)
        return descent.Search(problems, [], 0.0, derivatives_at)

    rungs = [[(3, 3), (3, 3)], [(5, 5), (5, 5)], [(5, 5), (9, 9)]]
    monkeypatch.setattr(descent.Search, "theta", jnp.zeros(3))
    monkeypatch.setattr(descent.Search, "best", NOWHERE)
    monkeypatch.setattr(mesh_ladder, "search", searched)
    monkeypatch.setattr(mesh_ladder, "ladder", lambda _: rungs)
    monkeypatch.setattr(mesh_ladder, "each_alone", lambda *_: [])
    monkeypatch.setattr(mesh_ladder, "weights", lambda _: [])
    monkeypatch.setattr(mesh_ladder, "is_too_coarse", lambda *_: True)
    monkeypatch.setattr(mesh_ladder, "look_again", lambda found, *_, **__: found)
    monkeypatch.setattr(mesh_ladder, "judged", lambda *_, **__: estimate_of_nothing())
    files = {"checkpoint": tmp_path / "card.progress.npz", "key": jr.key(0)}
    mesh_ladder.descend_by_meshes([lift(), lift()], SPACE, SMALL, **files)
    assert len(kept) == len(set(kept)) == 5


def test_where_all_diverges_on_a_finer_mesh_the_estimate_is_of_the_coarser_and_says_so(monkeypatch):
    climbed: list[tuple[int, bool]] = []

    def searched(problems, budget, **_):
        climbed.append((len(problems[0].scenario.scene.mesh.rest), budget.leads_on))
        if climbed[-1][0] == 25:
            raise RuntimeError("all starts of the descents diverged")
        return descent.Search(problems, [], 0.0, derivatives_at)

    monkeypatch.setattr(descent.Search, "theta", jnp.zeros(3))
    monkeypatch.setattr(descent.Search, "best", NOWHERE)
    monkeypatch.setattr(mesh_ladder, "search", searched)
    monkeypatch.setattr(mesh_ladder, "is_too_coarse", lambda *_: True)
    monkeypatch.setattr(mesh_ladder, "look_again", lambda found, *_, **__: found)
    monkeypatch.setattr(mesh_ladder, "judged", lambda *_, **__: estimate_of_nothing())
    monkeypatch.setattr(resolution, "LADDER", (2, 3, 5))
    told: list[str] = []
    monkeypatch.setattr(mesh_ladder, "tell", lambda _, words: told.append(words))
    found = mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, key=jr.key(0))
    assert climbed == [(9, True), (9, False), (25, False)]
    assert found.shape == (3, 3)
    assert found.refused.startswith("5 x 5 vertices") and "diverged" in found.refused
    assert any("back to 3 x 3" in words for words in told)
    assert from_json(as_json(found)).refused == found.refused
    with pytest.raises(RuntimeError, match="diverged"):  # the finest was asked for
        mesh_ladder.descend_by_meshes([lift()], SPACE, SMALL, finest=True, key=jr.key(0))


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
    def end(loss: float) -> Descent:
        none, theta, square = jnp.zeros(()), jnp.zeros(2), jnp.zeros((2, 2))
        normal = Normal(jnp.array(loss), none, none, theta, square, square)
        return Descent(theta, normal, none, none, none, jnp.zeros((), int))

    cloud, markers, exact = mesh_ladder.weights([end(4e-6), end(1e-8), end(0.0)])
    assert markers / cloud == pytest.approx(400)
    assert exact == pytest.approx(1e10)


def test_on_one_mesh_recordings_count_by_what_is_left_of_them_too(monkeypatch):
    """Searched alike first, then once more by their weights from where that led; not one alone."""
    asked: list[tuple[list[float | None], bool]] = []

    def searched(problems, budget, *, start=None, **_):
        weights = [None if each.weight is None else float(each.weight) for each in problems]
        asked.append((weights, start is not None and budget.near))
        return descent.Search(problems, [], 0.0, derivatives_at)

    monkeypatch.setattr(descent.Search, "theta", jnp.zeros(3))
    monkeypatch.setattr(descent.Search, "best", NOWHERE)
    monkeypatch.setattr(mesh_ladder, "search", searched)
    monkeypatch.setattr(mesh_ladder, "each_alone", lambda *_: [])
    monkeypatch.setattr(mesh_ladder, "weights", lambda _: [jnp.array(4.0), jnp.array(1.0)])
    monkeypatch.setattr(mesh_ladder, "judged", lambda *_, **__: estimate_of_nothing())
    named = {"approach": "diffcp", "key": jr.key(0)}
    mesh_ladder.descend_weighed((problem(1.5), problem(0.7)), SMALL, **named)
    assert asked == [([None, None], False), ([4.0, 1.0], True)]
    mesh_ladder.descend_weighed((problem(1.5),), SMALL, **named)
    assert asked[2:] == [([None], False)]


@pytest.mark.parametrize(("loss", "words"), [(1.2, "as it was"), (1.3, "5 x 5 vertices fit worse")])
def test_a_finer_mesh_that_fits_worse_is_another_minimum(loss, words):
    def rung(shape, loss):
        found = descent.Search((), [[of_loss(loss)]], 0.0, derivatives_at, (2, 3), "as it was")
        return mesh_ladder._Rung([shape], found)

    at = mesh_ladder._gone_on(rung((3, 3), 1.0), rung((5, 5), loss))
    assert at.found.reached == (2, 3) and at.found.unsure.startswith(words)
    assert at.shapes == [(5, 5)]


def estimate_of_nothing() -> Estimate:
    return Estimate(
        approach="none",
        fabric=SPACE(PLACE),
        ranges=SPACE.ranges,
        values=np.zeros(2),
        standard_errors=np.ones(2),
        mesh_bias=None,
        correlation=np.eye(2),
        nuisances=(),
        loss=0.0,
        losses=np.zeros((1, 1)),
        history=np.zeros((1, 1, 2)),
        seconds=0.0,
        converged=True,
    )
