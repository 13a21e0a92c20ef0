"""A stretching as the network takes it: markers, the motion of the clamps, and the force.

`pull_from` reads and checks a recording; `pulled` makes a synthetic one of a known fabric.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from scipy.interpolate import CubicSpline

from r2s._util.checks import expect
from r2s._util.units import GRAVITY
from r2s.estimation.problem import force_at
from r2s.materials.fabric import Fabric
from r2s.recordings.recording import Recording, RecordingInfo, interpolated, make_recording
from r2s.scenarios import clamp_force, energy_balance, stretching
from r2s.scenarios.standard import STRETCHING_INTERVAL
from r2s.scenarios.synthetic import MARKER_NOISE, markers_of

FEWEST_FRAMES = 3
FEWEST_SEEN = 0.5  # share of the markers that must be seen in every frame
OFF_PLACE = 0.1  # most a marker may begin away from its place, over the sheet's shorter side
OFF_PLANE = 0.02  # most a marker may leave the plane, over the same
STIFFNESSES = (0.3, 3e4)  # [N/m], those of fabrics, with room on both sides
SYNTHETIC_FRAMES = 39  # of 1/30 s
FORCE_NOISE = 0.01  # over the largest force


class Clamp(NamedTuple):
    """Motion of a clamp in every frame: displacement [m], velocity [m/s], acceleration [m/s^2]."""

    value: Float[Array, "*pull frame axis"]
    rate: Float[Array, "*pull frame axis"]
    acceleration: Float[Array, "*pull frame axis"]


class Pull(eqx.Module):
    """A sheet pulled in its plane between clamps at X = 0 and X = size[0], in the axes X and Y.

    - `size`: of the sheet between the clamps and across, [m].
    - `angle`: from X, the direction of the pull, to the warp, [rad].
    - `places`: of the markers on the sheet at rest, [m].
    - `displacement`: of the markers [m], where they are `seen`.
    - `seen`: which markers are seen in which frame.
    - `times`: of the frames, evenly spaced, [s].
    - `near`, `far`: the clamps at X = 0 and at the other end.
    - `force`: along X on the far clamp [N]; None: it was not measured.
    - `gravity`: its part in the plane [m/s^2]; zero on a horizontal table.
    - `normal`: its part that presses on the table [m/s^2]; zero without a table.
    """

    size: Float[Array, "*pull 2"]
    angle: Float[Array, "*pull"]
    places: Float[Array, "*pull marker 2"]
    displacement: Float[Array, "*pull frame marker axis"]
    seen: Bool[Array, "*pull frame marker"]
    times: Float[Array, "*pull frame"]
    near: Clamp
    far: Clamp
    force: Float[Array, "*pull frame"] | None
    gravity: Float[Array, "*pull axis"]
    normal: Float[Array, "*pull"]


def pull_from(recording: Recording, *, without_force: bool = False) -> Pull:
    """A stretching, in the plane of the sheet, from its recording.

    The pull is along the first side of the recording's sheet. The force is that on the clamp at the
    end of that side; a force of one number is taken along the pull. The model is that of a sheet in
    its plane: inertia, and on the table friction, while the table carries the weight. Where the
    recording does not say the places of its markers, they are a square grid, each marker in the
    middle of its cell.

    Raises `ValueError` that names the recording and says which condition it does not meet: of the
    frames, the markers, the clamps, and the force (unless `without_force`).
    """
    try:
        return _pull(recording, without_force)
    except ValueError as error:
        raise ValueError(f"recording {recording.info.name}: {error}") from error


def stacked(pulls: list[Pull]) -> Pull:
    """Several pulls as one, with a leading axis for `jax.vmap`.

    Raises `ValueError` when their shapes differ or only some have a force.
    """
    has_force = {pull.force is not None for pull in pulls}
    expect(len(has_force) == 1, "either all recordings have a force, or none")
    shapes = {pull.displacement.shape for pull in pulls}
    expect(len(shapes) == 1, f"recordings must have as many frames and markers, found {shapes}")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *pulls)


def _pull(recording: Recording, without_force: bool) -> Pull:
    sheet, (first, last) = recording.info.sheet, recording.info.frames_used
    size, used = np.asarray(sheet.size), slice(first, last + 1)
    axes = np.array([sheet.warp, sheet.weft, np.cross(sheet.warp, sheet.weft)])
    count = last - first + 1
    expect(count >= FEWEST_FRAMES, f"{count} frames: at least {FEWEST_FRAMES} are needed")
    if recording.markers is None or recording.markers_seen is None:
        raise ValueError("no markers: track them in each frame (r2s.recordings.markers.track)")
    recording = _evened(recording, used)
    times = np.asarray(recording.times, np.float64)[used]
    seen = np.asarray(recording.markers_seen)[used]
    world = np.asarray(recording.markers, np.float64)[used]
    local = (world - np.asarray(sheet.origin)) @ axes.T
    places = _places(recording, size, seen.shape[1])
    displacement = local[..., :2] - places
    _check_markers(seen, displacement, local[..., 2], first, min(size))
    near, far = _clamps(recording, times, axes, size)
    force = None if without_force else _force(recording, used, axes[0])
    if force is not None:
        _check_unit(force, far[0][:, 0] - near[0][:, 0], size)
    down = axes @ np.array([0.0, 0.0, -GRAVITY])
    array = partial(jnp.asarray, dtype=float)
    return Pull(
        size=array(size),
        angle=array(math.radians(recording.info.angle)),
        places=array(places),
        displacement=array(np.where(seen[..., None], displacement, 0)),
        seen=jnp.asarray(seen),
        times=array(times - times[0]),
        near=Clamp(*map(array, near)),
        far=Clamp(*map(array, far)),
        force=None if force is None else array(force),
        gravity=array(down[:2]),
        normal=array(abs(down[2])),
    )


def _evened(recording: Recording, used: slice) -> Recording:
    """The recording with the frames that count at even times, as equilibrium is computed from frame
    to frame. Markers are linear in between, and seen where they are in both frames around."""
    times = np.asarray(recording.times, np.float64)[used]
    even, steps = np.linspace(times[0], times[-1], len(times)), np.diff(times)
    if np.ptp(steps) <= 0.01 * steps.mean():
        return recording
    markers, seen = np.asarray(recording.markers), np.asarray(recording.markers_seen)
    between = interpolated(even, times, seen[used].astype(float)) > 1 - 1e-9
    places = interpolated(even, times, np.asarray(markers[used], np.float64))
    return dataclasses.replace(
        recording,
        times=recording.times.at[used].set(jnp.asarray(even, float)),
        markers=jnp.asarray(markers, float).at[used].set(jnp.asarray(places, float)),
        markers_seen=jnp.asarray(seen).at[used].set(jnp.asarray(between)),
    )


def _check_markers(
    seen: np.ndarray, displacement: np.ndarray, height: np.ndarray, first: int, side: float
) -> None:
    """Raise `ValueError` for markers that are missing, not on the sheet or not in its plane."""
    never = np.flatnonzero(~seen.any(axis=0))
    expect(len(never) == 0, f"markers {never} are seen in no frame: leave them out")
    share = seen.mean(axis=1)
    frame = int(share.argmin())
    few = f"frame {frame + first}: {seen[frame].sum()} of {seen.shape[1]} markers are seen"
    expect(share[frame] >= FEWEST_SEEN, f"{few}, at least {FEWEST_SEEN:.0%} are needed")
    off = np.where(seen[0], np.linalg.norm(displacement[0], axis=-1), 0)
    begins = f"marker {off.argmax()} begins {1e3 * off.max():.0f} mm from its place on the sheet"
    expect(off.max() <= OFF_PLACE * side, f"{begins}: in another order, or not in metres?")
    away = np.where(seen, np.abs(height), 0)
    frame, marker = np.unravel_index(away.argmax(), away.shape)
    flies = f"frame {frame + first}: marker {marker} is {1e3 * away.max():.1f} mm out of the plane"
    expect(away.max() <= OFF_PLANE * side, f"{flies} of the sheet, which must stay flat")


def _places(recording: Recording, size: np.ndarray, count: int) -> np.ndarray:
    """Places [m] of the markers on the sheet at rest."""
    if recording.marker_places is not None:
        return np.asarray(recording.marker_places, np.float64)
    side = math.isqrt(count)
    expect(side**2 == count, f"{count} markers are no square grid: give their places on the sheet")
    along = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2) * size


def _clamps(recording: Recording, times: np.ndarray, axes: np.ndarray, size: np.ndarray):
    """Displacement, velocity and acceleration of both clamps, by cubic splines of their path."""
    pinned = recording.info.sheet.pinned
    corners = {"origin": (0, 0), "weft": (0, 1), "warp": (1, 0), "opposite": (1, 1)}
    is_clamped = set(pinned) == set(corners)
    expect(is_clamped, f"a stretching is clamped at four corners, this sheet is held at {pinned}")
    world = np.asarray(recording.gripper_path, np.float64) - np.asarray(recording.info.sheet.origin)
    path = world @ axes[:2].T - np.array([corners[name] for name in pinned]) * size
    knots, columns = np.asarray(recording.gripper_times, np.float64), path.reshape(len(path), -1).T
    moved = np.stack([np.interp(times, knots, column) for column in columns], axis=1)
    spline = CubicSpline(times, moved.reshape(len(times), *path.shape[1:]))
    derivatives = np.stack([spline(times, order) for order in range(3)])
    ends = []
    for pair in (("origin", "weft"), ("warp", "opposite")):
        first, second = (derivatives[:, :, pinned.index(name)] for name in pair)
        is_straight = np.max(np.abs(first[0] - second[0])) <= 1e-3 * min(size)
        expect(is_straight, f"the clamp from {pair[0]} to {pair[1]} turns: it must go straight")
        ends.append((first + second) / 2)
    return ends


def _force(recording: Recording, used: slice, along: np.ndarray) -> np.ndarray:
    """The force [N] along the pull at the times of the frames."""
    force = force_at(recording, used)
    if force is None:
        raise ValueError(
            "no force: without it only ratios of stiffness are identifiable, not their scale; add "
            "the load cell's log (r2s.recordings.force_log)"
        )
    return np.asarray(force.values, np.float64) @ (np.asarray(force.directions) @ along)


def _check_unit(force: np.ndarray, pulled: np.ndarray, size: np.ndarray) -> None:
    """Raise `ValueError` when force over stretch is not the stiffness of any fabric."""
    stretch, (low, high) = pulled / size[0], STIFFNESSES
    moved = f"the clamps move apart by {1e3 * np.ptp(pulled):.2g} mm"
    expect(np.ptp(stretch) >= 1e-3, f"{moved}: no stretching, or not in metres")
    stiffness = float(np.polyfit(stretch, force / size[1], 1)[0])
    ratio = f"force over stretch is {stiffness:.3g} N/m, of fabrics {low:g} to {high:g}"
    expect(stiffness >= -low, f"{ratio}: the force must be positive along the pull")
    expect(low <= stiffness <= high, f"{ratio}: is the force in newtons, and the path in metres?")


def pulled(
    fabric: Fabric,
    name: str,
    angle: float = 0.0,
    *,
    shape: tuple[int, int] = (17, 17),
    frames: int = SYNTHETIC_FRAMES,
    marker_noise: float = MARKER_NOISE,
    force_noise: float = FORCE_NOISE,
    steps: int = 1,
    key: PRNGKeyArray,
    strain: float = 0.04,
    moving: float = 1.0,
) -> Recording:
    """A synthetic stretching of a fabric, with 81 markers and the force on the pulled clamp.

    - `name`: of the fabric, in the recording's. `angle`: from the pull to the warp, [rad].
    - `shape`: vertices of the sheet along its sides.
    - `marker_noise` [m], `force_noise`: over the largest force [-].
    - `steps`: of the simulation from frame to frame, of which a force is that of the last.
    - `strain`: by which the sheet is pulled, of its length [-]. `moving`: how long, [s].

    Raises `RuntimeError` when the simulation diverges, and `ValueError` for a pull that does not
    end within the frames.
    """
    experiment = stretching(num_frames=frames, strain=strain, moving=moving)
    fine = stretching(  # every step is a frame: its forces are those at its end
        num_frames=steps * (frames - 1) + 1,
        interval=STRETCHING_INTERVAL / steps,
        route=experiment.route,
    )
    scenario = dataclasses.replace(fine.scenario(shape), turn=jnp.asarray(angle, float))
    simulate = eqx.filter_jit(energy_balance)
    motion = simulate(scenario, fabric, STRETCHING_INTERVAL / steps)
    if not np.isfinite(np.asarray(motion.x)).all():
        raise RuntimeError(f"the simulation of {name} diverged")
    key_markers, key_force = jr.split(key)
    force = np.asarray(clamp_force(scenario, motion))[::steps]
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
        markers=markers_of(motion.x[::steps], scenario, key_markers, marker_noise),
        force=force + spread * np.asarray(jr.normal(key_force, force.shape, float)),
        force_times=experiment.times,
    )
