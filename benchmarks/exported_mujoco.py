"""The scenes of `exported` in MuJoCo, from what `r2s.export.mujoco` writes."""

import math

import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np

from r2s.export.mujoco import brake, mjcf

mujoco.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
STEP = 5e-4  # [s], at most


def motion(fabric, mesh, held, path, frames: int, rate: float, yarns: bool):
    """Positions [m] of the vertices at every frame, and the export's loss.

    `path`: a function of time [s] that gives the held vertices' places [m].
    """
    height, steps = float(path(0.0)[0, 2]), math.ceil(1 / rate / STEP)
    dt = 1 / rate / steps
    text, loss = mjcf(
        fabric, mesh, held=tuple(held), height=height, table=None, yarns=yarns, timestep=dt
    )
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    brake(model, fabric)
    data = mujoco.MjData(model)
    found = []
    for _ in range(frames):
        for _ in range(steps):
            data.mocap_pos[:] = path(data.time + dt)
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)  # positions lag by a step otherwise
        mujoco.mj_flex(model, data)
        found.append(data.flexvert_xpos.copy())
    done = abs(data.time - frames / rate) < 1e-6  # a run that diverges is reset to its start
    return (np.stack(found) if done else np.full((frames, *found[0].shape), np.nan)), loss
