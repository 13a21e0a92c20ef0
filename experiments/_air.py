"""MuJoCo's sheet as fabrics of r2s predict it, in one air or another."""

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.random as jr
import numpy as np
from _skills import from_lift_in_mujoco
from _tables import Line

from r2s.estimation.default_spaces import on_cloth
from r2s.estimation.estimate import Estimate
from r2s.estimation.estimate_json import as_json, from_json
from r2s.estimation.registry import METHODS
from r2s.evaluation.horizon import skill
from r2s.evaluation.prediction_error import from_surface, predict_motion
from r2s.fabrics import prior
from r2s.fabrics.fabric import Fabric
from r2s.files import write_json
from r2s.recordings.recording import Doubt, Recording
from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.scenario import from_recording
from r2s.study import engine, verdicts
from r2s.study.matrix import SMALL
from r2s.study.mujoco_recording import MujocoRecording
from r2s.study.mujoco_sheet import SHEET, as_plate
from r2s.study.sources import read, read_start
from r2s.study.starts import started
from r2s.world.air import Air

JUDGED, SHAPE = ("fling", "shaking"), (33, 33)
IN_DOUBT = 0.5  # relative, of the force of the air
PLACE, TURN = 0.015, 0.15  # [m] and [rad], as of all recordings that say nothing


def moved_in_air(folder: Path, fabric: str, drag: str, **skin: str) -> Line:
    """The line of a table: air, errors [mm] and skill of a fabric in both motions."""
    others, from_lift = from_lift_in_mujoco(folder, JUDGED)
    if fabric == "its material":
        found, made, air = as_plate(), {}, None
    else:
        estimate = from_lift if drag != "found" else _estimated(folder, ("lifting", "fling"))
        found, made = estimate.fabric, _told(estimate)
        (ratio, *_) = [each.value for each in estimate.nuisances if "air" in each.name] or [1.0]
        air = Air.make(drag_coefficient=2.0 * ratio, friction_coefficient=0.02 * ratio)
    if drag != "found":
        along = float(skin["skin friction"])
        air = Air.make(drag_coefficient=float(drag), friction_coefficient=along)
    assert air is not None
    line: Line = {}
    for motion in JUDGED:
        floor, default = (float(others[f"{motion}: {name}"]) for name in ("floor", "default"))
        error = _error(folder, motion, found, air)
        line |= {
            f"{motion}: floor": f"{floor:.1f}",
            f"{motion}: error": f"{error:.1f}",
            f"{motion}: default": f"{default:.1f}",
            f"{motion}: skill": f"{skill(error, default, floor):.2f}",
        }
    return line | {"numbers over the material's": _over(found), "air ratio": "-"} | made


def _error(folder: Path, motion: str, fabric: Fabric, air: Air) -> float:
    """Mean distance up to the horizon [mm], on the mesh and in the steps of a study."""
    source = MujocoRecording(motion, 0, True)
    recording = read(source, folder)
    scenario = started(from_recording(recording, SHAPE), read_start(source, folder))
    scenario = eqx.tree_at(lambda s: s.scene.air, scenario, air)
    x = predict_motion(scenario, fabric, explicit_cloth(scenario, fabric)).x
    judged = verdicts.judged_motion(source, folder)
    assert judged is not None
    return 1e3 * float(np.mean(from_surface(recording, x, SHAPE)[judged.inside]))


def _estimated(folder: Path, scenarios: tuple[str, ...]) -> Estimate:
    """As a study estimates, but for the air, which is in doubt."""
    file = folder / f"air_{'_'.join(scenarios)}.json"
    if not file.exists():
        recordings = [_in_doubt(_recorded(folder, each)) for each in scenarios]
        space = prior.informed(on_cloth(SHEET.density), SHEET.density)
        method = METHODS["diffcloud"](solver="cloth")
        found = method.estimate(recordings, space, SMALL.budgets.diffcloud, key=jr.key(0))
        write_json(file, as_json(found))
    return from_json(json.loads(file.read_text(encoding="utf-8")))


def _recorded(folder: Path, scenario: str) -> Recording:
    source = MujocoRecording(scenario)
    if not source.is_made(folder):
        engine.run([source], folder, engine.Serial())
    return read(source, folder)


def _in_doubt(recording: Recording) -> Recording:
    doubt = Doubt((PLACE, PLACE, PLACE), TURN, air=IN_DOUBT)
    return replace(recording, info=replace(recording.info, doubt=doubt))


def _over(fabric: Fabric) -> str:
    """Stiffness, bending and damping over the material's."""
    pairs = zip(_numbers(fabric), _numbers(as_plate()), strict=True)
    return ", ".join(f"{one / other:.2f}" for one, other in pairs)


def _numbers(fabric: Fabric) -> list[float]:
    membrane = fabric.membrane
    stiff = [membrane.c11, membrane.c22, membrane.c33]
    return [float(each) for each in (*stiff, fabric.bending.stiffness, fabric.damping)]


def _told(estimate: Estimate) -> Line:
    ratios = [each for each in estimate.nuisances if "air" in each.name]
    (air,) = ratios or (None,)
    return {} if air is None else {"air ratio": f"{air.value:.2f} +- {air.standard_error:.2f}"}
