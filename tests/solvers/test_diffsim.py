"""DiffSim: its step on the laws of r2s repeats its trajectories, and the cloth of r2s agrees."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import step
from diffsim_step import FOLDER, load, repeat, wind_force

from r2s._util.units import GRAVITY
from r2s.environment.air import Air
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.solvers.implicit.cloth import ImplicitCloth

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no trajectories in {FOLDER}")

FRAME = 0.04  # [s]: between the frames that are compared
FINE = 32  # DiffSim's steps of 10 ms are divided by it: its first order leaves a millimetre or two
STIFF = 100.0  # times the handles' stiffness: 10 N then move them by 0.1 mm
UNTIL = 10  # frames; later the motion amplifies any difference


def recordings(pattern: str, is_slow=lambda told: False):
    """The recordings of a kind, of which some are slow to compute."""
    found = sorted(path for path in FOLDER.glob(f"{pattern}.npz"))
    told = [json.loads(path.with_suffix(".json").read_text()) for path in found]
    marks = [[pytest.mark.slow(group="cloth")] if is_slow(settings) else [] for settings in told]
    return [
        pytest.param(path, id=path.stem, marks=mark)
        for path, mark in zip(found, marks, strict=True)
    ]


def rms(difference):
    """Root mean square over the vertices of a vector's length."""
    return np.sqrt(np.mean(np.sum(difference**2, axis=-1), axis=-1))


def side(setting):
    """Of the sheet, [m]."""
    return float(jnp.max(jnp.ptp(setting.mesh.rest, axis=0)))


@pytest.mark.parametrize("path", recordings("*", lambda told: told["n"] > 9 or told["steps"] > 300))
def test_its_step_on_our_laws_repeats_its_trajectory(path):
    setting, recorded = load(path)
    x, v = repeat(setting, recorded.counts)
    assert x == pytest.approx(recorded.x, abs=1e-6)  # 4e-12 m and 2e-11 m/s were measured
    assert v == pytest.approx(recorded.v, abs=1e-6)


def cloth_of(setting, dt):
    """The same sheet in the same air, with exact handles; the one drag is normal to the faces."""
    if float(setting.drag) != 0:
        pytest.skip("DiffSim's drag along the faces is linear in the flow, ours is quadratic")
    air = Air.make(float(setting.air_density), drag_coefficient=2.0, friction_coefficient=0.0)
    held = jnp.flatnonzero(setting.spring > 0)
    return ImplicitCloth(Scene(setting.mesh, held, air=air), dt)


def fabric_of(setting, damping):
    zero, thickness = jnp.zeros(()), jnp.asarray(1e-3)
    laws = setting.membrane, setting.bending
    return Fabric(setting.density, *laws, jnp.asarray(damping), zero, thickness, zero)


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("path", recordings("edge_*"))
def test_a_sheet_hung_by_its_edge_has_its_rest_shape(path):
    setting, recorded = load(path)
    solver, fabric = cloth_of(setting, dt=0.04), fabric_of(setting, damping=0.1)
    state = solver.init(setting.start)
    control = Control(state.x[solver.scene.pinned], setting.wind)
    for _ in range(30):
        before, state = state, step(solver, fabric, state, control)
    assert jnp.max(jnp.abs(state.x - before.x)) < 1e-6  # so it rests
    error = np.linalg.norm(np.asarray(state.x) - recorded.x[-1], axis=-1)
    assert np.max(error) < 2e-3 * side(setting)
    # 0.4 mm, which is what its handles give way: without that and with our gravity they agree
    x, _ = repeat(as_ours(setting, 1e4), np.array([100]))
    assert np.max(np.abs(np.asarray(state.x) - x[-1])) < 1e-6 * side(setting)


def as_ours(setting, stiffer):
    """DiffSim with stiffer handles and with the gravity of r2s."""
    weight = jnp.array([0.0, 0.0, -GRAVITY])
    return eqx.tree_at(lambda s: (s.spring, s.gravity), setting, (stiffer * setting.spring, weight))


def first_acceleration(setting):
    """Of an unstrained sheet at rest [m/s^2]: gravity and wind, but for the pinned vertices."""
    force = wind_force(setting, jnp.zeros_like(setting.start), setting.start)
    acceleration = force / setting.mass[:, None] - GRAVITY * jnp.eye(3)[2:]
    return jnp.where(setting.spring[:, None] > 0, 0.0, acceleration)


def roll(setting, dt):
    """Positions [m] of the first frames, by the cloth of r2s."""
    solver, fabric = cloth_of(setting, dt), fabric_of(setting, damping=0.0)
    state = solver.init(setting.start, None, first_acceleration(setting))
    frames, per_frame = [], round(FRAME / dt)
    for i in range(1, UNTIL * per_frame + 1):
        pinned = (setting.start + setting.moved(jnp.asarray(i * dt)))[solver.scene.pinned]
        state = step(solver, fabric, state, Control(pinned, setting.wind))
        if i % per_frame == 0:
            frames.append(np.asarray(state.x))
    return np.stack(frames)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("path", recordings("lift*_dt10") + recordings("hang2wind*_dt10"))
def test_the_motion_is_its_motion_in_the_limit_of_small_steps(path):
    setting, _ = load(path)
    x = roll(setting, dt=1.25e-3)
    errors = []
    for division in (1, FINE):
        theirs = eqx.tree_at(lambda s: s.dt, as_ours(setting, STIFF), setting.dt / division)
        counts = np.arange(1, UNTIL + 1) * round(FRAME / float(theirs.dt))
        errors.append(np.max(rms(x - repeat(theirs, counts)[0])))
    assert errors[1] < 0.01 * side(setting)
    assert errors[1] < 0.3 * errors[0]  # what they differ by at 10 ms is the error of its step
