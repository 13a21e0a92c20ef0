"""A scenario of r2s, in vacuum and without contact, as MuJoCo simulates the exported fabric."""

import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np

import r2s
from r2s.export.mujoco import brake, mjcf

STEPS, HEIGHT = 68, 0.5  # of MuJoCo in a frame; of the sheet that starts flat [m]


def in_mujoco(scenario: r2s.Scenario, fabric: r2s.Fabric) -> np.ndarray:
    """Positions [m] (frame, vertex, 3) of the exported fabric, from the first step on."""
    sheet, held, dt = scenario.scene.mesh, scenario.scene.held.tolist(), scenario.interval / STEPS
    text, _ = mjcf(fabric, sheet, held=tuple(held), height=HEIGHT, table=None, timestep=dt)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    brake(model, fabric)
    data, found = mujoco.MjData(model), []
    for frame in np.asarray(scenario.controls(STEPS).handles):
        for handles in frame:
            data.mocap_pos[:] = handles
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)  # positions lag by a step otherwise
        mujoco.mj_flex(model, data)
        found.append(data.flexvert_xpos.copy())
    return np.stack(found)
