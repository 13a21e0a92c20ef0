"""Verdicts of a study: errors within the horizon, beside the floor, as skill; ensembles."""

import dataclasses

import numpy as np
import pytest

import r2s
from r2s.evaluation import phase_free
from r2s.study import engine, results, verdicts
from r2s.study.comparisons import motion_comparisons
from r2s.study.ensembles import read_ensemble
from r2s.study.evaluations import EvaluationCell
from r2s.study.report.skill_table import skill_table
from r2s.study.report.truth_table import truth_table, verdict
from r2s.study.rows import Row
from r2s.study.sources import SyntheticRecording, TruthSettings, small_strain
from r2s.study.statistics.skills import skills, with_floor
from r2s.study.verdicts import BEYOND, SURFACE, Judged

FABRIC = "grey_interlock"


def row(value, baseline="", repeat="0", floor: float | None = 2e-3, metric=SURFACE):
    approach = "" if baseline else "diffcloud"
    whose = (approach, "cloth", "lifting" if approach else "", FABRIC, repeat)
    return Row(*whose, "fling_0", "fling", baseline, metric, "m", value, floor, 4.0)


def test_the_default_of_a_skill_is_the_mean_of_all_draws():
    drawn = [row(value, "default", str(i)) for i, value in enumerate((10e-3, 14e-3))]
    told = verdicts._with_skills(
        [row(7e-3), row(2e-3, "true", ""), row(np.nan, repeat="1"), *drawn]
    )
    assert [each.skill for each in told[:3]] == [pytest.approx(0.5), pytest.approx(1), -np.inf]
    assert all(each.skill is None for each in told[3:])
    # a draw that diverged raises no one's skill, and hides no run that diverged
    lost = [*drawn, row(np.nan, "default", "2")]
    again = verdicts._with_skills([row(7e-3), row(np.nan, repeat="1"), *lost])
    assert [each.skill for each in again[:2]] == [pytest.approx(0.5), -np.inf]
    none = verdicts._with_skills([row(7e-3), row(np.nan, repeat="1"), lost[-1]])
    assert [each.skill for each in none[:2]] == [None, -np.inf]
    near = [dataclasses.replace(each, value=2.5e-3) for each in drawn]
    assert verdicts._with_skills([row(1e-3), *near])[0].skill is None  # not clearly above the floor
    assert verdicts._with_skills([row(1e-3, floor=None), *drawn])[0].skill is None


def test_only_what_is_within_the_horizon_counts():
    times = np.arange(4.0)
    judged = Judged(times, np.array([1.0, 2.0, 3.0, 90.0]) * 1e-3, 2.0)
    found = verdicts._within(row(0.5), np.array([4.0, 6.0, 99.0, 99.0]) * 1e-3, judged)
    assert (found.value, found.floor, found.horizon) == (5e-3, 1.5e-3, 2.0)
    lost = verdicts._within(row(0.5), np.array([4e-3, np.nan, np.nan, np.nan]), judged)
    assert np.isnan(lost.value) and lost.floor == 1.5e-3  # diverged within it
    assert np.isnan(verdicts._within(row(0.5), times, judged._replace(horizon=0.0)).value)


def test_a_run_that_is_lost_counts_against_its_configuration_in_the_table():
    times = np.arange(4.0)
    judged = Judged(times, np.full(4, 1e-3), np.inf)
    runs = [
        verdicts._within(row(0.5, repeat=repeat), np.full(4, error), judged)
        for repeat, error in (("0", 3e-3), ("1", np.nan))
    ]
    drawn = verdicts._within(row(0.5, "default"), np.full(4, 9e-3), judged)
    rows = with_floor(verdicts._with_skills([*runs, drawn]), SURFACE)
    assert len(rows) == 3
    (lost,) = (each for c, each in skills(rows, "fling").items() if c.approach)
    assert (lost.mean, lost.diverged, lost.runs) == (-np.inf, 1, 2)
    line = skill_table(rows, SURFACE).rows[0]
    assert "1 of 2 diverged" in line[1] and "1 of 2 diverged" in line[3]


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
    found = phase_free.differences(drawn_anew, simulated, times)
    assert max(found[name] for name in ("width", "depth", "height", "sag")) < 1e-3, found
    assert found["area"] < 1e-3 and found["speed"] < 5e-3, found


@pytest.mark.slow(group="study")
def test_a_truth_is_judged_beside_its_own_ensemble(tmp_path, monkeypatch):
    """A 9 x 9 truth, its prediction on the same mesh, and the whole way to the rows."""
    monkeypatch.setattr("r2s.study.evaluations.SHAPES", {"cloth": (9, 9), "points": (9, 9)})
    source = SyntheticRecording(FABRIC, "fling", 0, True, TruthSettings((9, 9), stiffening=0.0))
    density = float(small_strain(FABRIC).density)
    cells = [EvaluationCell(None, "cloth", density, FABRIC, (source,), each) for each in (None, 0)]
    ensembles = verdicts.ensembles(cells)
    assert engine.run([*ensembles, *cells], tmp_path, engine.Serial()) == {}
    judged = verdicts.judged_motions(cells, tmp_path)[source]
    assert np.all(judged.floor > 0) and judged.floor.max() < 0.1
    rows = results.rows(cells, tmp_path)
    (true,) = (each for each in rows if each.baseline == "true" and each.metric == SURFACE)
    (drawn,) = (each for each in rows if each.baseline == "default" and each.metric == SURFACE)
    assert true.value < 1e-5  # it is the truth itself
    assert true.floor is not None and true.floor > 0
    assert drawn.value > 3e-3 and drawn.horizon == true.horizon
    (line,) = truth_table(cells, tmp_path).rows
    (ensemble,) = (read_ensemble(each, tmp_path) for each in ensembles)
    start = ensemble.causes["start"].mean()  # what settling again does, which predictions do
    assert 0 < start < 1e-3 and ensemble.causes["step"].mean() < 1e-3
    assert line[0] == source.name and float(line[2]) == pytest.approx(1e3 * true.floor, abs=0.01)
    (shown,) = motion_comparisons(cells, tmp_path)
    assert list(shown.motions) == ["true fabric on cloth", "default cloth"]
    assert shown.horizon == judged.horizon and np.all(shown.floor == judged.floor)
    inside = shown.mean_errors["default cloth"][shown.inside]
    assert inside.mean() == pytest.approx(drawn.value)
    if np.isfinite(judged.horizon):
        beyond = {each.metric for each in rows if each.baseline == "true"}
        assert {BEYOND + name for name in phase_free.UNITS} <= beyond


def test_a_truth_is_converged_where_mesh_and_step_leave_little_and_chaotic_where_trifles_grow():
    assert verdict(0.1e-3, 0.1e-3, 1.2e-3, 1.2e-3) == "converged"
    assert verdict(0.1e-3, 0.1e-3, 3e-3, 4e-3) == "not converged: 5.0 mm"
    assert verdict(2.1e-3, 0.1e-3, 0.1e-3, 0.1e-3) == "chaotic"
    assert verdict(0.0, 0.0, np.inf, 0.0) == "not converged: inf mm"
