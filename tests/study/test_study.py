"""The study: what a figure means, which cells there are, and that nothing is made twice."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folders import ROOT
from test_results import LIFTING

from r2s.cli.main import main
from r2s.estimation import default_spaces
from r2s.estimation.estimate import point_estimate
from r2s.estimation.method import default_space
from r2s.estimation.methods import MASS, METHODS, DiffCloud
from r2s.estimation.methods import STRETCH as MULTIPLIER
from r2s.materials import presets
from r2s.materials.arcsim import write_material
from r2s.study import engine, report, results
from r2s.study import plan as plans
from r2s.study.evaluations import EvaluationTask, Prediction
from r2s.study.recordings import (
    STRETCH,
    GivenRecording,
    SyntheticRecording,
    TruthSettings,
    small_strain,
    strain_dependent,
)
from r2s.study.report import cost_table, range_table
from r2s.study.tasks import read_metadata, with_dependencies


def test_what_is_judged_was_never_estimated_from():
    plan = plans.with_changes(plans.SMALL, repeats=3, judged=3)
    every = with_dependencies(plans.synthetic(plan))
    made = [cell for cell in every if isinstance(cell, SyntheticRecording)]
    assert len({cell.path(Path()) for cell in every}) == len(every)
    motions = [cell.experiment.route.path.tobytes() for cell in made if cell.angle is None]
    fabrics = {cell.fabric for cell in made}
    assert len(set(motions)) == len(motions) / len(fabrics)  # all fabrics are moved alike


@pytest.mark.slow(group="study")
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


def test_a_changed_file_of_measured_tables_is_another_recording(tmp_path):
    def recording():
        plan = plans.with_changes(plans.SMALL, fabrics=["grey_interlock"], materials=str(tmp_path))
        return plans.synthetic(plan)[0].recordings[0]

    truth, other = (presets.FIVE[name]() for name in ("grey_interlock", "pink_solid"))
    for name in presets.FIVE:
        write_material(tmp_path / f"{name}.json", truth)
    first = recording()
    assert recording().key == first.key
    write_material(tmp_path / "grey_interlock.json", other)
    changed = recording()
    assert isinstance(changed, SyntheticRecording) and changed.key != first.key
    made, own = strain_dependent("grey_interlock", changed.truth), small_strain("grey_interlock")
    assert made.membrane.stiffness[0, 0] == pytest.approx(float(other.membrane.c11))
    assert (made.damping, made.friction) == (own.damping, own.friction)  # no file has these
    assert changed.small_strain_fabric is None  # a table has no constant stiffness
    (tmp_path / "camel_ponte_roma.json").unlink()
    with pytest.raises(FileNotFoundError, match="camel_ponte_roma.json"):
        recording()


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

    monkeypatch.setattr(DiffCloud, "_estimate", fake)
    truth = TruthSettings((5, 5), 1 / 15)
    return plans.synthetic(plans.Plan((LIFTING,), ("grey_interlock",), 1, 1, truth))[-1:], made


def estimate_of(name):
    """The estimate of a grey interlock by a configuration."""
    plan = plans.with_changes(plans.SMALL, [name], ["grey_interlock"])
    return next(c.estimate for c in plans.synthetic(plan) if c.estimate is not None)


def test_multipliers_of_an_assumed_fabric_have_no_truth():
    task = estimate_of("diffcloud-published-cloth-lifting")
    ranges = (*default_space("cloth", task.density).ranges[:2], MULTIPLIER, MASS)
    true = results.true_values(task, ranges)
    assert np.isfinite(true).tolist() == [True, True, False, False]


def test_each_fabric_has_draws_of_its_own(tmp_path):
    """Else an unlucky draw would be the default of all, and no spread between fabrics show it."""
    plan = plans.with_changes(plans.SMALL, ["diffcloud-cloth-lifting"], list(presets.FIVE))
    stiffness = {}
    for each in (plan, plans.with_changes(plan, seed=1)):
        for cell in plans.synthetic(each):
            if cell.baseline == "default":
                drawn = cell._fabric(tmp_path)
                assert drawn is not None
                stiffness[cell.fabric, cell.draw, each.seed] = float(drawn.membrane.c11)
    assert len(stiffness) == 2 * 5 * plan.draws == len(set(stiffness.values()))


@pytest.mark.slow(group="study")
def test_an_estimate_is_made_once_and_judged(tiny, tmp_path):
    cells, made = tiny
    assert engine.run(cells, tmp_path, engine.Runner()) == {}
    found = results.collect(cells, tmp_path)
    assert set(found.approach) == {"diffcloud"} and set(found.repeat) == {"0"}
    assert np.isfinite(found.value).all() and (found.value > 0).all()
    engine.run(cells, tmp_path, engine.Runner())
    assert len(made) == 1
    parameters = results.parameters(cells, tmp_path)
    assert parameters.unit[0] == "N/m" and list(parameters.columns) == list(results.PARAMETERS)
    assert np.isfinite(parameters.truth).all()  # those of the preset
    report.publish_study(cells, {}, tmp_path, plans.SMALL, "synthetic")
    assert "diffcloud" in (tmp_path / "report.html").read_text(encoding="utf-8")
    written = {path.stem for path in (tmp_path / "tables").iterdir()}
    assert {"ranges", "costs", "parameters", "settings"} <= written
    costs = cost_table(cells, tmp_path).set_index("kind")
    assert costs["count"]["estimates diffcloud cloth lifting"] == 1
    assert float(costs["CPU seconds in all"]["evaluations cloth shaking"]) > 0


@pytest.mark.slow(group="study")
def test_an_estimate_that_diverges_is_a_result(tiny, tmp_path, monkeypatch):
    cells, _ = tiny

    def explode(method, recordings, space, budget, key):
        raise RuntimeError("every simulation diverged")

    monkeypatch.setattr(METHODS["diffcloud"], "_estimate", explode)
    assert engine.run(cells, tmp_path, engine.Runner()) == {}
    assert results.collect(cells, tmp_path).value.isna().all()
    reasons = read_metadata(cells[0], tmp_path)["diverged"]
    assert reasons == {source.name: "the estimate diverged" for source in cells[0].recordings}
    assert results.parameters(cells, tmp_path).empty


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "no-such-folder"), "no such folder"),
        (("--data", "r2s"), "no manifest.json"),
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


def test_what_trials_share_counts_once(tmp_path, monkeypatch):
    """A fold that two lifts are judged by has one default, whichever lift brought it."""

    def given(name, scenario, trial):
        return GivenRecording("knit", scenario, trial, "", name, "")

    every = [given(f"lift{i}", "lifting", f"{i}") for i in (1, 2, 3)]
    every += [given(f"fold{i}", "folding", f"{i}") for i in (1, 2)]
    monkeypatch.setattr(plans, "find_recordings", lambda folder: every)
    plan = dataclasses.replace(plans.SMALL, draws=1)
    cells = [
        cell
        for cell in plans.recorded(tmp_path, 0.2, plan)
        if cell.baseline == "default" and cell.solver == "cloth"
    ]
    # of trials 1 and 2 their own fold, of trial 3, which has none, both together
    assert [len(cell.recordings) for cell in cells] == [1, 1, 2]

    def predictions(cell, folder):
        nothing = np.zeros((0, 0, 3)), np.zeros(0)
        return {each.name: Prediction({"chamfer": 1.0}, *nothing) for each in cell.recordings}

    monkeypatch.setattr(results, "read_predictions", predictions)
    monkeypatch.setattr(EvaluationTask, "is_made", lambda cell, folder: True)
    found = results.collect(cells, tmp_path)
    assert sorted(found.recording) == ["fold1", "fold2"]


def test_a_fling_that_an_estimate_has_seen_does_not_judge_it(tmp_path, monkeypatch):
    scenarios = ["lifting", "wind", "stretching", "fling", "shaking"]
    every = [GivenRecording("knit", name, "1", "", name, "") for name in scenarios]
    monkeypatch.setattr(plans, "find_recordings", lambda folder: every)
    names = ["diffcloud-cloth-lifting", "diffcloud-cloth-lifting+wind+stretching+fling"]
    cells = plans.recorded(tmp_path, 0.2, plans.with_changes(plans.SMALL, names))
    judged_by = {
        (cell.estimate.scenario, source.name)
        for cell in cells
        if cell.estimate is not None
        for source in cell.recordings
    }
    alone, together = "lifting", "lifting+wind+stretching+fling"
    assert judged_by == {(alone, "fling"), (alone, "shaking"), (together, "shaking")}


def test_every_range_and_fixed_value_stands_in_the_table():
    table = range_table(plans.synthetic(plans.SMALL))
    shown = set(zip(table.solver, table.parameter, strict=True))
    for solver in ("cloth", "mpm"):
        space = default_space(solver, 0.2)
        names = [each.name for each in (*space.ranges, *default_spaces.fixed(space))]
        assert {(solver, name) for name in names} <= shown
    assert table["from"].notna().all() and (table["from"] != "").all()
