"""MuJoCo's sheet as fabrics of r2s predict it, in one air or another."""

from pathlib import Path

import equinox as eqx
import numpy as np
from _skills import from_lift_in_mujoco
from _tables import Line

from r2s.evaluation.horizon import skill
from r2s.evaluation.prediction_error import from_surface, predict_motion
from r2s.fabrics.fabric import Fabric
from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.scenario import from_recording
from r2s.study import verdicts
from r2s.study.mujoco_recording import MujocoRecording
from r2s.study.mujoco_sheet import as_plate
from r2s.study.sources import read, read_start
from r2s.study.starts import started
from r2s.world.air import Air

JUDGED, SHAPE = ("fling", "shaking"), (33, 33)


def moved_in_air(folder: Path, fabric: str, drag: str, **skin: str) -> Line:
    """The line of a table: errors [mm] and skill of a fabric in both motions, in an air of such
    coefficients, and its stiffness (warp, weft, shear), bending and damping over the material's."""
    others, estimate = from_lift_in_mujoco(folder, JUDGED)
    found = estimate.fabric if "estimate" in fabric else as_plate()
    along = float(skin["skin friction"])
    air = Air.make(drag_coefficient=float(drag), friction_coefficient=along)
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
    return line | {"numbers over the material's": _over(found)}


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


def _over(fabric: Fabric) -> str:
    pairs = zip(_numbers(fabric), _numbers(as_plate()), strict=True)
    return ", ".join(f"{one / other:.2f}" for one, other in pairs)


def _numbers(fabric: Fabric) -> list[float]:
    membrane = fabric.membrane
    stiff = [membrane.c11, membrane.c22, membrane.c33]
    return [float(each) for each in (*stiff, fabric.bending.stiffness, fabric.damping)]
