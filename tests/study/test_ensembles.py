"""Errors within the horizon, beside the floor of an ensemble; on truths that are known the true
fabric is better than the default."""

import dataclasses

import jax
import numpy as np
import pytest

import r2s
from r2s.materials import presets
from r2s.metrics import horizon
from r2s.study import engine, ensembles, results
from r2s.study.ensembles import BEYOND, SURFACE, Judged
from r2s.study.evaluations import EvaluationTask
from r2s.study.figures import judged_recordings
from r2s.study.plan import DRAWS
from r2s.study.recordings import SyntheticRecording, TruthSettings, small_strain
from r2s.study.report import truth_table, verdict

FABRIC = "grey_interlock"


def of_references(source, draws):
    """Evaluations of the true fabric and of samples of the prior."""
    density = float(small_strain(source.fabric).density)
    true = EvaluationTask(None, "cloth", density, source.fabric, (source,), "true")
    default = [dataclasses.replace(true, baseline="default", draw=i) for i in range(draws)]
    return [true, *default]


def test_only_what_is_within_the_horizon_counts():
    times = np.arange(4.0)
    judged = Judged(times, np.array([1.0, 2.0, 3.0, 90.0]) * 1e-3, 2.0)
    row = ensembles.within_horizon(np.array([4.0, 6.0, 99.0, 99.0]) * 1e-3, judged)
    assert row == {"value": 5e-3, "floor": 1.5e-3, "horizon": 2.0}
    diverged = ensembles.within_horizon(np.array([4e-3, 6e-3, np.nan, np.nan]), judged)
    assert np.isnan(diverged["value"]) and diverged["floor"] == 1.5e-3
    none = ensembles.within_horizon(times, judged._replace(horizon=0.0))
    assert np.isnan(none["value"]) and "floor" not in none


@pytest.mark.parametrize("shape", [(9, 9), (33, 33)])
def test_a_sheet_does_not_differ_from_itself_beyond_the_horizon_whatever_its_mesh(shape):
    """Clouds of 10,000 points of a still, flat sheet, and the sheet."""
    times, counts = np.arange(12) / 10, [10_000] * 12

    def clouds(shape):
        mesh = r2s.rectangle((0.45, 0.45), shape)
        still = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)))[None].repeat(12, axis=0)
        return ensembles.as_recorded(still, mesh.faces, counts)

    simulated = clouds(shape)
    assert [len(cloud) for cloud in simulated] == counts
    drawn_anew = [cloud[::-1] for cloud in clouds((17, 17))]
    found = horizon.differences(drawn_anew, simulated, times)
    assert max(found[name] for name in ("width", "depth", "height", "sag")) < 1e-3, found
    assert found["area"] < 1e-3 and found["speed"] < 5e-3, found


@pytest.mark.slow(group="study")
def test_a_truth_is_judged_beside_its_own_ensemble(tmp_path, monkeypatch):
    """A 9 x 9 truth, its prediction on the same mesh, and the whole way to the rows."""
    monkeypatch.setattr("r2s.study.evaluations.SHAPES", {"cloth": (9, 9), "mpm": (9, 9)})
    settings = TruthSettings((9, 9), stiffening=0.0)
    source = SyntheticRecording(FABRIC, "fling", 0, True, truth=settings)
    tasks = of_references(source, 1)
    assert engine.run([*ensembles.ensembles(tasks), *tasks], tmp_path, engine.Runner()) == {}
    judged = ensembles.judged_motions(tasks, tmp_path)[source]
    assert np.all(judged.floor > 0) and judged.floor.max() < 0.1
    rows = results.collect(tasks, tmp_path)
    surface = rows[rows.metric == SURFACE]
    (true,) = surface[surface.baseline == "true"].itertuples()
    (drawn,) = surface[surface.baseline == "default"].itertuples()
    assert true.value < 1e-5  # it is the truth itself
    assert true.floor > 0
    assert drawn.value > 3e-3 and drawn.horizon == true.horizon
    (line,) = truth_table(tasks, tmp_path).to_dict("records")
    start = judged.causes["start"].mean()  # what settling again does, which predictions do
    assert 0 < start < 1e-3 and judged.causes["step"].mean() < 1e-3
    assert line["recording"] == source.name
    assert float(line["floor [mm]"]) == pytest.approx(1e3 * true.floor, abs=0.01)
    (shown,) = judged_recordings(tasks, tmp_path)
    assert list(shown.vertices) == ["true fabric on cloth", "default cloth"]
    inside = shown.mean_errors["default cloth"][shown.inside]
    assert inside.mean() == pytest.approx(drawn.value)
    if np.isfinite(judged.horizon):
        beyond = set(rows[rows.baseline == "true"].metric)
        assert {BEYOND + name for name in horizon.UNITS} <= beyond


def test_a_truth_is_converged_where_mesh_and_step_leave_little_and_chaotic_where_trifles_grow():
    assert verdict(0.1e-3, 0.1e-3, 1.2e-3, 1.2e-3) == "converged"
    assert verdict(0.1e-3, 0.1e-3, 3e-3, 4e-3) == "not converged: 5.0 mm"
    assert verdict(2.1e-3, 0.1e-3, 0.1e-3, 0.1e-3) == "chaotic"
    assert verdict(0.0, 0.0, np.inf, 0.0) == "not converged: inf mm"


KNOWN = 1 / 3  # of what fabrics differ by: mesh and step, mean up to the horizon
EARLY = 0.5  # [s]: before this one a horizon shows nothing
NOT_KNOWN = ("red_jet_set", "shaking")  # the mesh passes half of that after a quarter of a second
CONVERGED = {
    ("pink_solid", "fling"),
    ("red_jet_set", "fling"),
    ("black_denim", "shaking"),
    ("pink_solid", "shaking"),
    NOT_KNOWN,
}


@pytest.mark.slow(group="verdicts")
@pytest.mark.parametrize("motion", ["fling", "shaking"])
@pytest.mark.parametrize("fabric", presets.FIVE)
def test_the_true_fabric_beats_the_default_where_the_truth_is_known(tmp_path, fabric, motion):
    """In single precision, as studies are made: floors are the same in float64 (docs/study.md)."""
    tasks = of_references(SyntheticRecording(fabric, motion, 0, True), DRAWS)
    with jax.enable_x64(False):
        assert engine.run([*ensembles.ensembles(tasks), *tasks], tmp_path, engine.Runner()) == {}
        found = results.collect(tasks, tmp_path)
    found = found[found.metric == SURFACE]
    (true,) = found[found.baseline == "true"].itertuples()
    (judged,) = ensembles.judged_motions(tasks, tmp_path).values()
    stiffness, path, mesh, step = (
        float(judged.causes[cause][:, judged.inside].mean())
        for cause in ("stiffness", "path", "mesh", "step")
    )
    between = np.mean(np.sqrt(np.mean(judged.apart**2, axis=1)))
    assert true.value < found[found.baseline == "default"].value.mean()
    words = verdict(stiffness, path, mesh, step)
    assert words != "chaotic" and (words == "converged") == ((fabric, motion) in CONVERGED), words
    if (fabric, motion) == NOT_KNOWN:
        assert true.horizon < EARLY and np.isnan(true.skill)
    else:
        assert np.hypot(mesh, step) < KNOWN * between
        assert true.horizon > EARLY and true.skill > 0
