"""MuJoCo's flex in the scene "hang": the same membrane (Green strain) on the same mesh.

The model is the export's, whose masses are those of the vertices' areas: it is that of r2s but for
the bending, and the two converge to the same motion. The pinned vertices have no joints.
"""

from functools import partial

import _hang
import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np

from r2s.export.mujoco import mjcf

mujoco.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run


def _model(integrator: str, size: int, substeps: int, damping: float):
    mesh, step = _hang.sheet(size), 1 / (60 * substeps)
    text, _ = mjcf(_hang.fabric(damping), mesh, table=None, yarns=False, timestep=step)
    spec = mujoco.MjSpec.from_string(text)
    for pinned in (0, size - 1):
        for joint in spec.body(f"v{pinned}").joints:
            spec.delete(joint)
    model = spec.compile()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
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


forward_implicit = partial(_forward, "DISCRETE")  # linearly implicit, MuJoCo >= 3.13
forward_explicit = partial(_forward, "EULER")
