"""Synthetic recordings of a known fabric that is pulled along any direction."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s.materials.fabric import Fabric
from r2s.recordings.recording import Recording, RecordingInfo, make_recording
from r2s.scenarios import clamp_force, energy_balance, stretching
from r2s.scenarios.standard import STRETCHING_INTERVAL
from r2s.scenarios.synthetic import MARKER_NOISE, markers_of

FRAMES = 39  # of 1/30 s
FORCE_NOISE = 0.01  # over the largest force

_account = eqx.filter_jit(energy_balance)


def pulled(
    fabric: Fabric,
    name: str,
    angle: float = 0.0,
    *,
    shape: tuple[int, int] = (17, 17),
    frames: int = FRAMES,
    marker_noise: float = MARKER_NOISE,
    force_noise: float = FORCE_NOISE,
    steps: int = 1,
    key: PRNGKeyArray,
    strain: float = 0.04,
    moving: float = 1.0,
) -> Recording:
    """A stretching of a fabric, with 81 markers and the force on the pulled clamp.

    - `name`: of the fabric, in the recording's.
    - `angle`: from the pull to the warp, [rad].
    - `shape`: vertices of the sheet along its sides.
    - `marker_noise` [m], `force_noise`: over the largest force [-].
    - `steps`: of the simulation from frame to frame. A force is that of the last of them, as a load
      cell shows it at its frame's time, and not their mean.
    - `strain`: by which the sheet is pulled, of its length [-]. `moving`: how long, [s].

    Raises `RuntimeError` when the simulation diverges, and `ValueError` for a pull that does not
    end within the frames.
    """
    experiment = stretching(num_frames=frames, strain=strain, moving=moving)
    # every step is a frame of what is simulated: its forces are those at its end
    each_step = stretching(
        num_frames=steps * (frames - 1) + 1,
        interval=STRETCHING_INTERVAL / steps,
        route=experiment.route,
    )
    scenario = each_step.scenario(shape)
    scenario = dataclasses.replace(scenario, turn=jnp.asarray(angle, float))
    found = _account(scenario, fabric, STRETCHING_INTERVAL / steps)
    if not np.isfinite(np.asarray(found.x)).all():
        raise RuntimeError(f"the simulation of {name} diverged")
    key_markers, key_force = jr.split(key)
    force = np.asarray(clamp_force(scenario, found))[::steps]
    spread = force_noise * np.abs(force).max()
    info = RecordingInfo(
        name=f"stretching_{name}_{np.degrees(angle):.0f}",
        scenario="stretching",
        fabric=name,
        trial="1",
        source=f"synthetic: {name}, pulled at {np.degrees(angle):.0f} degrees from its warp",
        frames_used=experiment.frames_used,
        sheet=experiment.sheet,
        table_height=experiment.table_height,
        verified=None,
        angle=round(float(np.degrees(angle)), 9),
    )
    return make_recording(
        None,
        experiment.times,
        experiment.route.path,
        experiment.route.times,
        info,
        markers=markers_of(found.x[::steps], scenario, key_markers, marker_noise),
        force=force + spread * np.asarray(jr.normal(key_force, force.shape, float)),
        force_times=experiment.times,
    )
