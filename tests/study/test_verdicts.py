"""Verdicts of a study: errors within the horizon, beside the floor; ensembles."""

import numpy as np
import pytest

import r2s
from r2s.metrics import horizon
from r2s.study import engine, results, verdicts
from r2s.study.ensembles import read_ensemble
from r2s.study.evaluations import EvaluationTask
from r2s.study.recordings import SyntheticRecording, TruthSettings, small_strain
from r2s.study.report.figures import judged_recordings
from r2s.study.report.tables import truth_table, verdict
from r2s.study.verdicts import BEYOND, SURFACE, Judged

FABRIC = "grey_interlock"


def test_only_what_is_within_the_horizon_counts():
    times = np.arange(4.0)
    judged = Judged(times, np.array([1.0, 2.0, 3.0, 90.0]) * 1e-3, 2.0)
    found = verdicts.within_horizon(np.array([4.0, 6.0, 99.0, 99.0]) * 1e-3, judged)
    assert found == {"value": 5e-3, "floor": 1.5e-3, "horizon": 2.0}
    lost = verdicts.within_horizon(np.array([4e-3, 6e-3, np.nan, np.nan]), judged)
    assert np.isnan(lost["value"]) and lost["floor"] == 1.5e-3  # diverged, if later
    none = verdicts.within_horizon(times, judged._replace(horizon=0.0))
    assert np.isnan(none["value"]) and "floor" not in none


@pytest.mark.parametrize("shape", [(9, 9), (33, 33)])
def test_a_sheet_does_not_differ_from_itself_beyond_the_horizon_whatever_its_mesh(shape):
    """Clouds of 10,000 points of a still, flat sheet, and the sheet."""
    times, counts = np.arange(12) / 10, [10_000] * 12

    def clouds(shape):
        mesh = r2s.rectangle((0.45, 0.45), shape)
        still = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)))[None].repeat(12, axis=0)
        return verdicts.as_recorded(still, mesh.faces, counts)

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
    source = SyntheticRecording(FABRIC, "fling", 0, True, TruthSettings((9, 9), stiffening=0.0))
    density = float(small_strain(FABRIC).density)
    cells = [EvaluationTask(None, "cloth", density, FABRIC, (source,), each) for each in (None, 0)]
    ensembles = verdicts.ensembles(cells)
    assert engine.run([*ensembles, *cells], tmp_path, engine.Serial()) == {}
    judged = verdicts.judged_motions(cells, tmp_path)[source]
    assert np.all(judged.floor > 0) and judged.floor.max() < 0.1
    rows = results.collect(cells, tmp_path)
    surface = rows[rows.metric == SURFACE]
    (true,) = surface[surface.baseline == "true"].itertuples()
    (drawn,) = surface[surface.baseline == "default"].itertuples()
    assert true.value < 1e-5  # it is the truth itself
    assert true.floor > 0
    assert drawn.value > 3e-3 and drawn.horizon == true.horizon
    (line,) = truth_table(cells, tmp_path).to_dict("records")
    (ensemble,) = (read_ensemble(each, tmp_path) for each in ensembles)
    start = ensemble.causes["start"].mean()  # what settling again does, which predictions do
    assert 0 < start < 1e-3 and ensemble.causes["step"].mean() < 1e-3
    assert line["recording"] == source.name
    assert float(line["floor [mm]"]) == pytest.approx(1e3 * true.floor, abs=0.01)
    (shown,) = judged_recordings(cells, tmp_path)
    assert list(shown.vertices) == ["true fabric on cloth", "default cloth"]
    assert shown.horizon == judged.horizon and np.all(shown.floor == judged.floor)
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
