"""MuJoCo's flex in the scene "hang": the same membrane (Green strain) on the same mesh.

Its own masses are equal for all vertices; they are set to those of the areas, so that the model is
that of r2s but for the bending, and the two converge to the same motion.
"""

from functools import partial

import _hang
import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np

from r2s._util.units import GRAVITY
from r2s.export.mujoco import flexcomp

mujoco.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
MODEL = """
<mujoco>
  <option timestep="{step}" gravity="0 0 -{gravity}" integrator="{integrator}">
    <flag contact="disable"/>
  </option>
  <size memory="2G"/>
  <worldbody>{flex}</worldbody>
</mujoco>
"""


def _model(integrator: str, size: int, substeps: int, damping: float):
    mesh, step = _hang.sheet(size), 1 / (60 * substeps)
    flex, _ = flexcomp(_hang.fabric(damping), mesh, held=(0, size - 1))
    text = MODEL.format(step=step, gravity=GRAVITY, integrator=integrator, flex=flex)
    model = mujoco.MjModel.from_xml_string(text)
    free = model.flex_vertbodyid > 0  # the others belong to the world
    bodies = model.flex_vertbodyid[free]
    scale = _hang.DENSITY * np.asarray(mesh.vertex_area)[free] / model.body_mass[bodies]
    model.body_mass[bodies] *= scale
    model.body_inertia[bodies] *= scale[:, None]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _forward(integrator: str, size: int, substeps: int, damping: float):
    model = _model(integrator, size, substeps, damping)
    data = mujoco.MjData(model)

    def call():
        mujoco.mj_resetData(model, data)
        frames = []
        for _ in range(_hang.FRAMES):
            mujoco.mj_step(model, data, nstep=substeps)
            mujoco.mj_kinematics(model, data)  # positions lag by a step otherwise
            mujoco.mj_flex(model, data)
            frames.append(data.flexvert_xpos.copy())
        # a run that diverges is reset to its start
        done = abs(data.time - _hang.FRAMES / 60) < 1e-6
        return np.stack(frames) if done else np.full_like(frames, np.nan)

    return call


forward_implicit = partial(_forward, "discrete")  # linearly implicit, MuJoCo >= 3.13
forward_explicit = partial(_forward, "Euler")
