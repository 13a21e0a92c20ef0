"""The study: what a figure means, which cells there are, and that nothing is made twice."""

import dataclasses
import itertools
import re
import runpy
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from folders import ROOT

from r2s import scenarios
from r2s.cli.main import main
from r2s.cli.study import Study
from r2s.estimation.baselines import MASS
from r2s.estimation.baselines import STRETCH as MULTIPLIER
from r2s.estimation.estimate import point_estimate
from r2s.estimation.method import default_space
from r2s.estimation.pinn.pulls import pulled
from r2s.estimation.registry import METHODS
from r2s.materials import presets, prior
from r2s.materials.arcsim import write_material
from r2s.materials.informed_space import InformedSpace
from r2s.metrics import prediction_error
from r2s.recordings.recording import cloud
from r2s.scenarios import synthetic
from r2s.scenarios.standard import LIMITS, SIX
from r2s.solvers.failures import Failure
from r2s.solvers.simulate import Trajectory
from r2s.study import engine, estimates, matrix, results
from r2s.study.cells import dependencies, read_metadata, with_dependencies
from r2s.study.configuration import (
    APPROACHES,
    MOTIONS,
    PAPER_CONFIGURATIONS,
    PUBLISHED_CONFIGURATIONS,
    Configuration,
)
from r2s.study.drawn import numbers_of
from r2s.study.estimates import EstimateCell, TrainedNetwork
from r2s.study.evaluations import EvaluationCell
from r2s.study.mujoco_cells import MujocoRecording
from r2s.study.report import disclosures
from r2s.study.report.tables import recording_table
from r2s.study.sources import (
    STRETCH,
    GivenRecording,
    SyntheticRecording,
    TruthSettings,
    small_strain,
    strain_dependent,
)
from r2s.study.statistics.frame import as_frame


@pytest.fixture(scope="module")
def lift():
    return synthetic.record(scenarios.lifting(), presets.grey_interlock(), "grey", key=jr.key(1))


@pytest.fixture(scope="module")
def predicted(lift):
    """The motion of the lift with its true fabric."""
    return prediction_error.predict(lift, presets.grey_interlock())


def test_a_recording_is_at_no_distance_from_itself(lift):
    found = prediction_error.against_recording(lift, lift)
    assert all(value == 0 for value in found.values())


def test_the_true_fabric_is_nearer_than_another_and_than_noise_allows(lift, predicted):
    truth = prediction_error.against_motion(lift, predicted)
    other = prediction_error.against_motion(
        lift, prediction_error.predict(lift, presets.pink_solid())
    )
    # 1 mm of noise, sampling of the surface every 5 mm, one point in a hundred 0.2 m away
    assert truth["chamfer_real_to_sim"] < 0.007
    assert truth["chamfer_real_to_sim"] < other["chamfer_real_to_sim"]
    assert truth["hausdorff"] >= truth["chamfer"]


@pytest.mark.slow(group="study")
def test_a_whole_surface_tells_the_true_fabric_by_every_metric():
    experiment, fabric = SIX["fling"](), presets.grey_interlock()
    seen = synthetic.record(experiment, fabric, "grey", seen=synthetic.WHOLE, key=jr.key(0))
    clouds = [cloud(seen, frame) for frame in (0, 30)]
    assert all(len(points) == len(clouds[0]) > 5000 for points in clouds)
    truth, other = (
        prediction_error.against_motion(seen, prediction_error.predict(seen, each), 6, False)
        for each in (fabric, presets.pink_solid())
    )
    for name, value in truth.items():
        assert value < other[name] / 1.5, name
    assert truth["hausdorff"] < 0.01  # samples of the surface, 8 mm apart


def test_a_diverged_motion_is_a_result(lift):
    shape = (len(lift.times), 81, 3)
    found = prediction_error.against_motion(lift, np.full(shape, np.nan))
    whole = prediction_error.against_recording(lift, lift)
    assert found.keys() == whole.keys()
    assert all(np.isnan(value) for value in found.values())


def test_a_run_that_fails_is_lost_from_there_on_and_says_why(monkeypatch):
    failed = Trajectory(
        x=jnp.zeros((3, 9, 3)),
        ok=jnp.array([True, False, True]),
        failure=jnp.array(Failure.NON_FINITE.value),
        failed_frame=jnp.array(1),
        failed_step=jnp.array(2),
    )
    monkeypatch.setattr(prediction_error, "_rollout", lambda *_, **__: failed)
    scenario = SIX["fling"]().scenario((3, 3))
    moved = prediction_error.predict_motion(scenario, presets.grey_interlock())
    assert np.isfinite(moved.x).all(axis=(1, 2)).tolist() == [True, False, False]
    assert "frame 1, step 2" in moved.failure


def test_the_cropped_distance_leaves_out_what_the_recording_cannot_show(lift, predicted):
    found = prediction_error.against_motion(lift, predicted)
    assert found["chamfer_sim_to_real_cropped"] < found["chamfer_sim_to_real"]
    assert cloud(lift, 20)[:, 2].min() > 0


def test_the_configurations_of_the_paper_are_part_of_all():
    assert set(PAPER_CONFIGURATIONS) <= set(matrix.FULL)
    assert len(set(matrix.FULL)) == len(matrix.FULL)
    for cell in matrix.synthetic(matrix.PRESETS["three_fabrics"]):
        assert cell.scenario in MOTIONS
        assert all(
            isinstance(source, SyntheticRecording | MujocoRecording) and source.unseen
            for source in cell.recordings
        )


def test_small_has_every_approach_both_solvers_two_fabrics_and_six_scenarios():
    every = with_dependencies(matrix.synthetic(matrix.SMALL))
    estimated = [cell for cell in every if isinstance(cell, EstimateCell)]
    assert {cell.approach for cell in estimated} == set(estimates.SOLVERS)
    assert {cell.solver for cell in estimated} == {"cloth", "points"}
    assert len({cell.fabric for cell in estimated}) >= 2
    assert len({cell.scenario for cell in every if isinstance(cell, SyntheticRecording)}) == 6
    networks = [
        need
        for cell in estimated
        for need in dependencies(cell)
        if isinstance(need, TrainedNetwork)
    ]
    assert networks and all(network.scenario == "lifting" for network in networks)


def test_what_is_judged_was_never_estimated_from():
    plan = matrix.with_changes(matrix.SMALL, repeats=3, judged=3)
    every = with_dependencies(matrix.synthetic(plan))
    made = [cell for cell in every if isinstance(cell, SyntheticRecording)]
    assert len({cell.path(Path()) for cell in every}) == len(every)
    motions = [cell.experiment.route.path.tobytes() for cell in made if cell.angle is None]
    fabrics = {cell.fabric for cell in made}
    assert len(set(motions)) == len(motions) / len(fabrics)  # all fabrics are moved alike


def test_a_truth_has_the_stiffness_of_the_preset_at_rest_and_more_when_stretched():
    preset, truth = small_strain("grey_interlock"), strain_dependent("grey_interlock")

    def tangent(law, strain):
        return np.asarray(jax.hessian(law.energy_density)(jnp.asarray(strain)))

    rest, stretched = [0.0, 0.0, 0.0], [(STRETCH**2 - 1) / 2, 0.0, 0.0]
    for law, small in ((truth.membrane, preset.membrane), (truth.bending, preset.bending)):
        assert tangent(law, rest) == pytest.approx(tangent(small, rest))
    half_way = 1.5 * float(preset.membrane.c11)  # to twice as much
    assert tangent(truth.membrane, stretched)[0, 0] == pytest.approx(half_way)
    assert isinstance(
        strain_dependent("grey_interlock", TruthSettings(stiffening=0.0)), type(preset)
    )
    dampings = {float(small_strain(name).damping) for name in presets.FIVE}
    frictions = {float(small_strain(name).friction) for name in presets.FIVE}
    assert len(dampings) == len(frictions) == len(presets.FIVE)


def test_motions_of_different_scenarios_are_drawn_apart():
    places = []
    for scenario in MOTIONS:
        low, high = np.array(list(LIMITS[scenario].values())).T
        drawn = numbers_of(scenario, 1, True, 0)
        places.append(((np.array(list(drawn.values())) - low) / (high - low))[:2])
    assert all(np.max(np.abs(a - b)) > 0.01 for a, b in itertools.combinations(places, 2))


def test_a_changed_file_of_measured_tables_is_another_recording(tmp_path):
    def recordings():
        plan = matrix.with_changes(
            matrix.SMALL, fabrics=["grey_interlock"], materials=str(tmp_path)
        )
        return [cell.recordings[0] for cell in matrix.synthetic(plan)]

    truth, other = (presets.FIVE[name]() for name in ("grey_interlock", "pink_solid"))
    for name in presets.FIVE:
        write_material(tmp_path / f"{name}.json", truth)
    first, again = recordings(), recordings()
    write_material(tmp_path / "grey_interlock.json", other)
    changed = recordings()
    assert [cell.key for cell in first] == [cell.key for cell in again]
    assert not {cell.key for cell in first} & {cell.key for cell in changed}
    assert isinstance(changed[0], SyntheticRecording)
    made = strain_dependent("grey_interlock", changed[0].truth)
    assert made.membrane.stiffness[0, 0] == pytest.approx(float(other.membrane.c11))
    own = small_strain("grey_interlock")
    assert (made.damping, made.friction) == (own.damping, own.friction)  # no file has these
    for name in presets.FIVE:  # those that are compared with are inputs, too
        write_material(tmp_path / f"{name}.json", truth if name == "pink_solid" else other)
        assert {cell.key for cell in recordings()} != {cell.key for cell in changed}
    plan = matrix.with_changes(
        matrix.SMALL, fabrics=["grey_interlock"], materials=str(tmp_path)
    )  # a table has no fabric of constant stiffness
    assert "true" not in {cell.baseline for cell in matrix.synthetic(plan)}
    (tmp_path / "camel_ponte_roma.json").unlink()
    with pytest.raises(FileNotFoundError, match="camel_ponte_roma.json"):
        matrix.with_changes(matrix.SMALL, fabrics=["camel_ponte_roma"], materials=str(tmp_path))


@pytest.fixture
def tiny(monkeypatch):
    """One configuration and fabric, whose estimate is the middle of the space, without work."""
    made = []

    def fake(method, recordings, space, budget, key):
        made.append(method)
        middle = jnp.full(space.dim, 0.5)
        values = np.asarray(space.values(middle))
        losses = np.full((1, 1), 1e-4)
        found = point_estimate("fake", space, middle, 1e-4, losses, values[None, None], 0.1)
        return dataclasses.replace(found, shape=method.chosen_shape)

    monkeypatch.setattr(METHODS["diffcloud"], "_estimate", fake)
    plan = matrix.Plan(
        (Configuration("diffcloud", "cloth", "lifting"),),
        ("grey_interlock",),
        1,
        1,
        TruthSettings((5, 5), 1 / 15),
    )
    return matrix.synthetic(plan)[-1:], made


def test_the_middle_of_the_prior_stands_beside_every_estimate(tmp_path):
    """On each solver and in each motion once; its fabric knows the weight alone."""
    cells = matrix.synthetic(matrix.with_changes(matrix.SMALL, fabrics=["grey_interlock"]))
    middles = [cell for cell in cells if cell.baseline == "middle"]
    places = [(cell.solver, cell.scenario) for cell in middles]
    assert sorted(places) == sorted(itertools.product(("cloth", "points"), MOTIONS))
    found, density = middles[0]._fabric(tmp_path), middles[0].density
    assert found is not None and middles[0].repeat == ""
    for one, other in zip(*map(jax.tree.leaves, (found, prior.middle(density))), strict=True):
        assert one == other


def test_what_is_estimated_on_points_is_judged_on_the_cloth_too():
    """There alone are all fabrics simulated alike, on the mesh of the truths."""
    names = ["diffcp-points-lifting"]
    cells = matrix.synthetic(matrix.with_changes(matrix.SMALL, names, ["grey_interlock"]))
    both = {c.solver: c for c in cells if c.estimate is not None and c.scenario == "fling"}
    assert (both["points"].baseline, both["cloth"].baseline) == ("", "on_cloth")
    assert both["points"].estimate == both["cloth"].estimate
    assert len({cell.name for cell in cells}) == len(cells)
    assert {c.solver for c in cells if c.baseline == "default"} == {"cloth", "points"}


def test_a_lift_and_the_pulls_of_the_network_are_estimated_from_together():
    names = ["diffcloud-cloth-lifting+stretching", "pinn-cloth-stretching"]
    plan = matrix.with_changes(matrix.SMALL, names, ["grey_interlock", "mujoco_flex"])  # of all
    every = {c.estimate for c in matrix.synthetic(plan) if c.estimate is not None}
    both, pulls = sorted(every, key=lambda each: each.approach)  # none of MuJoCo's sheet
    assert both.scenario == "lifting+stretching" and pulls.scenario == "stretching"
    assert [each.scenario for each in both.sources[:1]] == ["lifting"]
    assert both.sources[1:] == pulls.sources
    assert both.law == "told" and pulls.law == "linear"  # as the command has them
    assert [getattr(each, "angle", None) for each in pulls.sources] == [0.0, 45.0, 90.0]
    label = "DIFFCLOUD cloth lifting+stretching"
    assert label in {c.configuration.label for c in matrix.synthetic(plan)}
    with pytest.raises(ValueError, match="from one recording, got 4"):
        dataclasses.replace(both, approach="physnet")
    with pytest.raises(ValueError, match="pinn: on cloth it estimates from stretching, not from l"):
        dataclasses.replace(both, approach="pinn")


def test_published_recipes_are_configurations_of_their_own_whatever_a_plan_cuts():
    names = ["-".join(each) for each in PUBLISHED_CONFIGURATIONS]
    names.append("physnet-cloth-lifting")
    plan = matrix.with_changes(matrix.SMALL, names, ["grey_interlock"])
    every = {c.estimate for c in matrix.synthetic(plan) if c.estimate is not None}
    published = {each for each in every if each.approach != "physnet"}
    assert {each.approach for each in published} == {f"{name}-published" for name in APPROACHES}
    for each in published:
        assert each.budget == METHODS[each.approach].budget and len(each.sources) == 1
        assert (each.prior, each.law, each.resolves) == ("flat", "linear", False)
    (own,) = every - published
    (theirs,) = (each for each in published if each.name.startswith("physnet-published_cloth_l"))
    assert own.network == theirs.network and own.budget != theirs.budget
    labels = [each.label for each in PUBLISHED_CONFIGURATIONS]
    assert labels[0] == "DIFFCLOUD as published cloth lifting" and len(set(labels)) == 8


def test_multipliers_of_an_assumed_fabric_have_no_truth():
    plan = matrix.with_changes(
        matrix.SMALL, ["diffcloud-published-cloth-lifting"], ["grey_interlock"]
    )
    cell = next(c.estimate for c in matrix.synthetic(plan) if c.estimate is not None)
    ranges = (*default_space("cloth", cell.density).ranges[:2], MULTIPLIER, MASS)
    true = results.true_values(cell, ranges)
    assert np.isfinite(true).tolist() == [True, True, False, False]


def test_given_recordings_of_one_fabric_and_trial_go_together():
    def given(name, fabric, scenario, trial):
        return GivenRecording("", name, fabric, scenario, trial, "")

    every = [
        given("pull", "knit", "stretching", "1"),
        given("lift", "knit", "lifting", "1"),
        given("lift of another trial", "knit", "lifting", "2"),
        given("lift of another fabric", "denim", "lifting", "1"),
    ]
    (found,) = matrix._together(every, ("lifting", "stretching"))
    assert [each.name for each in found] == ["lift", "pull"]
    assert len(matrix._together(every, ("lifting",))) == 3


def test_each_fabric_has_draws_of_its_own(tmp_path):
    """Else an unlucky draw would be the default of all, and no spread between fabrics show it."""
    plan = matrix.with_changes(matrix.SMALL, ["diffcloud-cloth-lifting"], list(presets.FIVE))
    stiffness = {}
    for each in (plan, matrix.with_changes(plan, seed=1)):
        for cell in matrix.synthetic(each):
            if cell.baseline == "default":
                drawn = cell._fabric(tmp_path)
                assert drawn is not None
                stiffness[cell.fabric, cell.draw, each.seed] = float(drawn.membrane.c11)
    assert len(stiffness) == 2 * 5 * plan.draws == len(set(stiffness.values()))


@pytest.mark.parametrize("name", ["diffcloud-cloth-lifting", "pinn-cloth-stretching"])
def test_who_heeds_a_prior_is_told_of_fabrics_of_this_weight(name, tmp_path, monkeypatch):
    plan = matrix.with_changes(matrix.SMALL, [name], ["grey_interlock"])
    cell = next(c.estimate for c in matrix.synthetic(plan) if c.estimate is not None)
    seen = []

    def told(cell, recordings, space, folder):
        seen.append(space)
        raise RuntimeError("enough")

    monkeypatch.setattr(EstimateCell, "_estimated", told)
    shape, motion = (3, 3), {"frames": 6, "moving": 0.1, "steps": 3}
    recording = pulled(prior.middle(0.2), "any", shape=shape, **motion, key=jr.key(0))
    monkeypatch.setattr(estimates, "read", lambda source, folder: recording)
    assert "enough" in cell.make(tmp_path, tmp_path)["diverged"]
    assert isinstance(seen[0], InformedSpace) == name.startswith("diffcloud")
    assert (estimates.method_of(cell).shape is None) == name.startswith("diffcloud")


@pytest.mark.slow(group="study")
def test_an_estimate_is_made_once_and_judged(tiny, tmp_path):
    cells, made = tiny
    assert engine.run(cells, tmp_path, engine.Serial()) == {}
    found = results.collect(cells, tmp_path)
    assert set(found.approach) == {"diffcloud"} and set(found.repeat) == {"0"}
    assert np.isfinite(found.value).all() and (found.value > 0).all()
    engine.run(cells, tmp_path, engine.Serial())
    assert len(made) == 1
    parameters = results.parameters(cells, tmp_path)
    assert parameters.unit[0] == "N/m" and not np.isfinite(parameters.standard_error).any()
    assert np.isfinite(parameters.truth).all()  # those of the preset
    meshes = disclosures.mesh_table(results.estimates_made(cells, tmp_path), tmp_path)
    assert len(meshes) == 1 and meshes.iloc[0, 2:].astype(float).gt(0).all()
    results.publish(cells, {}, tmp_path, matrix.SMALL, "synthetic")
    assert "diffcloud" in (tmp_path / "report.html").read_text(encoding="utf-8")
    written = {path.stem for path in (tmp_path / "tables").iterdir()}
    assert {"ranges", "meshes", "costs", "parameters_cloth", "settings"} <= written
    costs = disclosures.cost_table(cells, tmp_path).set_index("kind")
    assert costs["count"]["estimates diffcloud cloth lifting"] == 1
    assert float(costs["CPU seconds in all"]["evaluations cloth shaking"]) > 0


@pytest.mark.slow(group="study")
def test_an_estimate_that_diverges_is_a_result(tiny, tmp_path, monkeypatch):
    cells, _ = tiny

    def explode(method, recordings, space, budget, key):
        raise RuntimeError("every simulation diverged")

    monkeypatch.setattr(METHODS["diffcloud"], "_estimate", explode)
    assert engine.run(cells, tmp_path, engine.Serial()) == {}
    assert results.collect(cells, tmp_path).value.isna().all()
    reasons = read_metadata(cells[0], tmp_path)["diverged"]
    assert reasons == {source.name: "the estimate diverged" for source in cells[0].recordings}
    assert results.parameters(cells, tmp_path).empty


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "no-such-folder"), "no such folder"),
        (("--data", "r2s"), "no recording"),
        (("--data", "r2s", "--density", "-1"), "must be positive"),
        (("--fabrics", "silk"), "no preset 'silk'"),
        (("--configurations", "diffcp-felt"), "no configuration 'diffcp-felt'; there"),
        (("--columns", "diffcp-cloth-wind"), "no configuration 'diffcp-cloth-wind': it diff"),
        (("--configurations", "pinn-cloth-wind"), "the network from clouds .* does not find the"),
        (("--judged", "0"), "judged must be at least 1"),
    ],
)
def test_a_wrong_call_says_what_is_wrong_and_writes_nothing(arguments, message, tmp_path, capsys):
    out = tmp_path / "results"
    given = [str(ROOT / each) if each == "r2s" else each for each in arguments]
    assert main(["study", *given, "--out", str(out)]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert not out.exists()


def test_the_driver_is_the_command(monkeypatch):
    options = ["--configurations", "diffcloud-cloth-lifting", "diffcloud-cloth-wind"]
    options += ["--fabrics", "grey_interlock", "black_denim", "--out", "here", "--workers", "2"]
    monkeypatch.setattr(sys, "argv", ["study.py", *options])
    monkeypatch.setattr("r2s.__main__.command", lambda: main(sys.argv[1:]))
    found = []
    monkeypatch.setattr(Study, "run", lambda self: found.append(self))
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(ROOT / "experiments" / "study.py"), run_name="__main__")
    (settings,) = found
    assert settings.configurations == (("diffcloud-cloth-lifting", "diffcloud-cloth-wind"),)
    assert settings.fabrics == (("grey_interlock", "black_denim"),)
    assert settings.out == Path("here") and settings.workers == 2


@pytest.mark.slow(group="study")
def test_an_estimate_without_memory_is_missing_and_no_divergence(tiny, tmp_path, monkeypatch):
    estimated = tiny[0][0].estimate

    def exhaust(method, recordings, space, budget, key):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(METHODS["diffcloud"], "_estimate", exhaust)
    failed = engine.run([estimated], tmp_path, engine.Serial())
    assert "out of memory" in failed[estimated] and not estimated.is_made(tmp_path)


def test_what_trials_share_counts_once(tmp_path, monkeypatch):
    """A fold that two lifts are judged by has one default, whichever lift brought it."""

    def given(name, scenario, trial):
        return GivenRecording("", name, "knit", scenario, trial, "")

    every = [given(f"lift{i}", "lifting", f"{i}") for i in (1, 2, 3)]
    every += [given(f"fold{i}", "folding", f"{i}") for i in (1, 2)]
    monkeypatch.setattr(matrix, "find_recordings", lambda folder: every)
    plan = dataclasses.replace(matrix.SMALL, draws=1)
    cells = [
        cell
        for cell in matrix.recorded(tmp_path, 0.2, plan)
        if cell.baseline == "default" and cell.solver == "cloth"
    ]
    # of trials 1 and 2 their own fold, of trial 3, which has none, both together
    assert [len(cell.recordings) for cell in cells] == [1, 1, 2]
    measured = {cell: {each.name: {"chamfer": 1.0} for each in cell.recordings} for cell in cells}
    monkeypatch.setattr(results, "read_measured", lambda cell, folder: measured[cell])
    monkeypatch.setattr(EvaluationCell, "is_made", lambda cell, folder: True)
    found = results.collect(cells, tmp_path)
    assert sorted(found.recording) == ["fold1", "fold2"]


def test_a_fling_that_an_estimate_has_seen_does_not_judge_it(tmp_path, monkeypatch):
    scenarios = ["lifting", "wind", "stretching", "fling", "shaking"]
    every = [GivenRecording("", name, "knit", name, "1", "") for name in scenarios]
    monkeypatch.setattr(matrix, "find_recordings", lambda folder: every)
    names = ["diffcloud-cloth-lifting", "diffcloud-cloth-lifting+wind+stretching+fling"]
    cells = matrix.recorded(tmp_path, 0.2, matrix.with_changes(matrix.SMALL, names))
    judged_by = {
        (cell.estimate.scenario, source.name)
        for cell in cells
        if cell.estimate is not None
        for source in cell.recordings
    }
    alone, together = "lifting", "lifting+wind+stretching+fling"
    assert judged_by == {(alone, "fling"), (alone, "shaking"), (together, "shaking")}


def test_given_recordings_are_shown_one_by_one():
    def row(baseline, value, recording="fold_silk", repeat="0", solver="cloth"):
        is_estimate = baseline in ("", "other_fabric", "on_cloth")
        return {
            "approach": "diffcloud" if is_estimate else "",
            "solver": "" if baseline == "repeatability" else solver,
            "estimated_from": "lifting" if is_estimate else "",
            "fabric": "silk",
            "repeat": repeat,
            "recording": recording,
            "evaluated_on": "folding",
            "baseline": baseline,
            "metric": "chamfer_real_to_sim",
            "unit": "m",
            "value": value,
        }

    rows = [row("", 0.02), row("default", 0.03), row("other_fabric", 0.025)]
    rows += [row("repeatability", 0.01), row("", 0.09, repeat="1"), row("on_cloth", 0.5)]
    rows += [row("default", 0.04, "fold_silk2"), row("default", 0.05, "fold_silk2", repeat="1")]
    rows += [row("default", 0.7, solver="points")]
    table = recording_table(as_frame(rows), "chamfer_real_to_sim").set_index("recording")
    first, second = table.loc["fold_silk"], table.loc["fold_silk2"]
    assert dict(first[["estimate", "default", "other_fabric", "repeatability"]]) == {
        "estimate": 20.0, "default": 30.0, "other_fabric": 25.0, "repeatability": 10.0
    }  # fmt: skip
    assert second.default == 45.0 and np.isnan(second.estimate)
    assert recording_table(as_frame(rows[:2]), "chamfer_real_to_sim").empty  # as synthetic ones
