"""A sheet of MuJoCo's flex follows its grippers, lies on its table, and is a part of a study."""

import dataclasses
import importlib.util
import sys
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from r2s.cli.study import Study
from r2s.scenarios.standard import SCENARIOS
from r2s.study import engine
from r2s.study.ensembles import EnsembleTask, judged_motions
from r2s.study.evaluations import EvaluationTask, read_predictions
from r2s.study.mujoco import FABRIC, Material, MujocoRecording, as_plate, moved

has_mujoco = importlib.util.find_spec("mujoco") is not None
needs_mujoco = pytest.mark.skipif(not has_mujoco, reason="needs r2s[mujoco]")
SHEET = Material()
COARSE: dict[str, Any] = {"shape": (5, 5), "step": 1 / 300}


def motion(experiment, material=SHEET, shape=(5, 5), step=1 / 300):
    return moved(experiment.scenario(shape), material, step)


@pytest.fixture(scope="module")
def moves():
    """A sheet in the four scenarios that MuJoCo takes."""
    if not has_mujoco:
        pytest.skip("needs r2s[mujoco]")
    names = ("lifting", "folding", "fling", "shaking")
    return {name: motion(SCENARIOS[name]()) for name in names}


def test_held_vertices_follow_the_path(moves):
    for name, x in moves.items():
        experiment = SCENARIOS[name]()
        route, held = experiment.route, np.asarray(experiment.scenario((5, 5)).scene.pinned)
        path = route.path.reshape(len(route.times), -1).T
        wanted = np.stack([np.interp(experiment.times, route.times, along) for along in path], 1)
        np.testing.assert_allclose(x[:, held].reshape(len(x), -1), wanted, atol=1e-5)


def test_a_sheet_lies_on_the_table_and_not_below_it(moves):
    lying, radius = moves["lifting"][0], Material().radius
    np.testing.assert_allclose(lying[:, 2], radius, atol=2e-4)
    for x in moves.values():
        assert x[..., 2].min() > -1e-3


def test_a_hanging_sheet_is_at_rest_below_its_grippers_and_stretches_by_its_weight(moves):
    x, material = moves["fling"], Material()
    side, stiffness = 0.45, material.young * material.thickness
    assert np.abs(x[1] - x[0]).max() < 1e-3  # the grippers wait
    fallen = x[0, 0, 2] - x[0, 4::5, 2].mean()
    # at most what a sheet that is pulled evenly gives: it hangs by two corners, and sags between
    stretched = material.density * 9.81 * side / (2 * stiffness)
    assert 0.9 * side < fallen < (1 + 3 * stretched) * side


@needs_mujoco
def test_a_sheet_that_is_lost_is_an_error_that_says_when():
    scenario = SCENARIOS["lifting"]().scenario(COARSE["shape"])
    torn = dataclasses.replace(scenario, path=scenario.path.at[-1].set(jnp.nan))
    with pytest.raises(RuntimeError, match=r"diverged after 3\.\d+ s"):
        moved(torn, SHEET, COARSE["step"])


@pytest.mark.slow(group="study")
@needs_mujoco
def test_half_the_step_changes_less_than_a_step_that_is_twice_as_long():
    experiment = SCENARIOS["lifting"](num_frames=8, moving=0.4)

    def change(step):
        """Of the positions, when the step is halved, rms [m]."""
        first, second = (
            motion(experiment, shape=(13, 13), step=shorter) for shorter in (step, step / 2)
        )
        return np.sqrt(np.square(first - second).sum(axis=-1).mean())

    assert change(1 / 600) < change(1 / 150) / 2


def test_a_scenario_that_mujoco_s_sheet_does_not_have_is_refused():
    with pytest.raises(ValueError, match="not wind"):
        MujocoRecording(FABRIC, "wind")


def test_a_study_without_the_wheel_says_so_before_it_makes_anything(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    out = tmp_path / "results"
    with pytest.raises(ImportError, match=r"r2s\[mujoco\].*leave mujoco_flex out of --fabrics"):
        Study(out=out, preset="three_fabrics").run()
    assert not out.exists()


@pytest.mark.slow(group="study")
@needs_mujoco
def test_ours_predicts_the_sheet_of_mujoco_from_where_it_hangs(tmp_path):
    source = MujocoRecording(FABRIC, "fling", unseen=True, shape=(13, 13), step=2e-3)
    task = EvaluationTask(None, "cloth", 0.2, FABRIC, (source,), "default", every=3)
    assert engine.run([task], tmp_path, engine.Runner()) == {}
    (found,) = read_predictions(task, tmp_path).values()
    assert found.metrics["chamfer_real_to_sim"] < 0.03
    start = motion(source.experiment, shape=(13, 13), step=2e-3)[0]
    assert start[:, 2].min() == pytest.approx(found.x[0, :, 2].min(), abs=0.02)


@pytest.mark.slow(group="verdicts")
@needs_mujoco
def test_the_ensemble_of_a_recording_is_its_own_simulator_s(tmp_path):
    """Trifles leave less than meshes, meshes less than fabrics; the floor has the larger ones."""
    recording = MujocoRecording(FABRIC, "fling", unseen=True, shape=(9, 9), step=4e-3)
    task = EnsembleTask(recording)
    assert not engine.run([task], tmp_path, engine.Runner())
    evaluation = EvaluationTask(None, "cloth", 0.2, FABRIC, (recording,), "true")
    (found,) = judged_motions([evaluation], tmp_path).values()
    assert set(found.causes) == {"recording", "stiffness", "path", "mesh", "step"}
    assert found.causes["stiffness"].shape == found.causes["path"].shape == (2, len(found.times))
    assert found.causes["recording"].mean() < 1e-4
    left = {cause: float(rows.mean()) for cause, rows in found.causes.items()}
    assert left["stiffness"] < left["mesh"] < found.apart.mean()
    assert (found.apart.mean(axis=1) > left["path"]).all()
    assert (found.floor >= found.causes["mesh"][0]).all()


def test_a_material_is_the_plate_that_stretches_shears_and_bends_as_it_does():
    fabric = as_plate(Material(young=2e4, poisson=0.25, thickness=2e-3, density=0.3))
    law = fabric.membrane
    assert float(law.c11 - law.c12**2 / law.c22) == pytest.approx(2e4 * 2e-3, rel=1e-5)  # E h
    assert float(law.c12 / law.c11) == pytest.approx(0.25, rel=1e-5)
    assert float(law.c33) == pytest.approx(2e4 * 2e-3 / 2.5, rel=1e-5)  # E h / (2 (1 + nu))
    stiffness = 2e4 * 2e-3**3 / 12 / (1 - 0.25**2)  # [N m]
    assert float(fabric.bending.stiffness) == pytest.approx(stiffness, rel=1e-5)
    assert float(fabric.density) == pytest.approx(0.3)
