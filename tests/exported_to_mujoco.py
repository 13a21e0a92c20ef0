"""A sheet that falls in vacuum while some vertices are carried, in r2s and in MuJoCo."""

import jax.numpy as jnp
import numpy as np

import r2s
from r2s.cloth.linear.elimination import Elimination
from r2s.export.mujoco import brake, mjcf
from r2s.study.mujoco_sheet import mujoco_module
from r2s.units import GRAVITY

SIDE, SIZE, HEIGHT = 0.3, 9, 0.5  # [m], vertices a side, of the sheet that starts flat [m]
FRAMES, INTERVAL, SUBSTEPS, STEPS = 45, 1 / 30, 4, 68  # -, [s], steps of r2s and MuJoCo in a frame
MOTIONS = {"lift": [0], "drape": [0, SIZE - 1, SIZE**2 - SIZE, SIZE**2 - 1]}  # held vertices


def scenario_of(motion: str) -> r2s.Scenario:
    """A motion: "lift" carries one corner up and inward, "drape" brings the four corners together.

    The held vertices ease in and out within a second.
    """
    mesh, held = r2s.rectangle((SIDE, SIDE), (SIZE, SIZE)), MOTIONS[motion]
    start = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)), constant_values=HEIGHT)
    way = (start[held].mean(axis=0) - start[held]) / 20 if motion == "drape" else (0.07, 0.07, 0.2)
    times = INTERVAL * np.arange(FRAMES + 1)
    eased = np.clip(times, 0, 1) ** 2 * (3 - 2 * np.clip(times, 0, 1))
    scene = r2s.Scene(mesh, jnp.array(held), r2s.Table.make(-jnp.inf), r2s.Air.make(density=0.0))
    falling = jnp.array([0.0, 0.0, -GRAVITY])
    return r2s.Scenario(
        scene=scene,
        elimination=Elimination.make(mesh),
        start=jnp.asarray(start, float),
        path=jnp.asarray(start[held] + eased[:, None, None] * np.asarray(way), float),
        path_times=jnp.asarray(times, float),
        first_time=jnp.asarray(INTERVAL, float),
        interval=INTERVAL,
        num_frames=FRAMES,
        lead_in=1,
        substeps=SUBSTEPS,
        acceleration=jnp.where(scene.is_free[:, None], falling, 0.0),
    )


def in_mujoco(scenario: r2s.Scenario, fabric: r2s.Fabric) -> np.ndarray:
    """Positions [m] (frame, vertex, 3) of the exported fabric, without contact."""
    mujoco = mujoco_module()
    sheet, held, dt = scenario.scene.mesh, scenario.scene.held.tolist(), INTERVAL / STEPS
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
