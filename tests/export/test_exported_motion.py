"""A fabric that is exported to MuJoCo hangs there as it does in r2s."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r2s
from r2s._util.units import GRAVITY
from r2s.export.mujoco import brake, mjcf

FABRIC = r2s.Fabric.make(0.2, (100.0, 30.0, 100.0, 35.0), 1e-5, damping=2e-4, mass_damping=3.0)
SIDE, SIZE, HEIGHT = 0.3, 9, 0.5  # [m], vertices a side, of the sheet that starts flat [m]
FRAMES, INTERVAL, SUBSTEPS, STEPS = 45, 1 / 30, 4, 68  # -, [s], steps of r2s and MuJoCo in a frame
CORNERS = (0, SIZE - 1, SIZE**2 - SIZE, SIZE**2 - 1)


def drape() -> r2s.Scenario:
    """The four corners come together within a second, in vacuum, while the sheet falls."""
    mesh, held = r2s.rectangle((SIDE, SIDE), (SIZE, SIZE)), jnp.array(CORNERS)
    start = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)), constant_values=HEIGHT)
    corners = start[held]
    times = INTERVAL * np.arange(FRAMES + 1)
    eased = np.clip(times, 0, 1) ** 2 * (3 - 2 * np.clip(times, 0, 1))
    way = (corners.mean(axis=0) - corners) / 20
    scene = r2s.Scene(mesh, held, air=None)
    falling = jnp.array([0.0, 0.0, -GRAVITY])
    return r2s.Scenario(
        scene=scene,
        start=jnp.asarray(start, float),
        path=jnp.asarray(corners + eased[:, None, None] * way, float),
        path_times=jnp.asarray(times, float),
        first_time=jnp.asarray(INTERVAL, float),
        interval=INTERVAL,
        num_frames=FRAMES,
        lead_in=1,
        substeps=SUBSTEPS,
        acceleration=jnp.where(scene.is_free[:, None], falling, 0.0),
    )


def in_mujoco(scenario: r2s.Scenario) -> np.ndarray:
    """Positions [m] (vertex, 3) of the exported fabric at the end, without contact."""
    mujoco = pytest.importorskip("mujoco", reason="needs r2s[mujoco]")
    dt, sheet = INTERVAL / STEPS, scenario.scene.mesh
    text, _ = mjcf(FABRIC, sheet, pinned=CORNERS, height=HEIGHT, table=None, timestep=dt)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    brake(model, FABRIC)
    data = mujoco.MjData(model)
    for pinned in np.asarray(scenario.controls(STEPS).pinned):
        data.mocap_pos[:] = pinned
        mujoco.mj_step(model, data)
    mujoco.mj_kinematics(model, data)  # positions lag by a step otherwise
    mujoco.mj_flex(model, data)
    return data.flexvert_xpos.copy()


@pytest.mark.slow(group="motions")
def test_an_exported_fabric_hangs_in_mujoco_as_ours_does() -> None:
    """As users run it: in single precision, promotion as usual."""
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        scenario = drape()
        theirs = in_mujoco(scenario)
        ours = np.asarray(eqx.filter_jit(r2s.rollout)(scenario, FABRIC).x)
    distance = np.sqrt(np.mean(np.sum((ours[-1] - theirs) ** 2, axis=-1))) / SIDE
    moved = np.sqrt(np.mean(np.sum((ours[-1] - ours[0]) ** 2, axis=-1))) / SIDE
    assert distance < 0.05 < moved
