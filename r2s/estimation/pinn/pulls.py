"""What the network is given of a stretching: markers, the motion of the clamps, and the force.

`pull_from` takes it from a recording and checks it.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.interpolate import CubicSpline

from r2s.recordings.recording import Recording, check_covered
from r2s.units import GRAVITY

FEWEST_FRAMES = 3
FEWEST_SEEN = 0.5  # share of the markers that must be seen in every frame
OFF_PLACE = 0.1  # most a marker may begin away from its place, over the sheet's shorter side
OFF_PLANE = 0.02  # most a marker may leave the plane, over the same
STIFFNESSES = (0.3, 3e4)  # [N/m], those of fabrics, with room on both sides


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


def pull_from(
    recording: Recording,
    angle: float | None = None,
    *,
    places: Float[np.ndarray, "marker 2"] | None = None,
    without_force: bool = False,
) -> Pull:
    """A stretching, in the plane of the sheet, from its recording.

    The pull is along the first side of the recording's sheet. The force is that on the clamp at the
    end of that side; a force of one number is taken along the pull. The model is that of a sheet in
    its plane: inertia, and on the table friction, while the table carries the weight.

    - `angle`: from the pull to the warp [rad]: pi / 2 in a pull along the weft, pi / 4 on the bias;
      None: what the recording says.
    - `places`: of the markers on the sheet at rest [m]; None: what the recording says, and where it
      does not, a grid with as many rows as columns, each marker in the middle of its cell.
    - `without_force`: leave the force out.

    Raises `ValueError` for fewer than 3 frames, times that do not increase evenly, markers that are
    missing, lost, off the sheet or out of its plane, another way of holding, and a force that is
    missing, does not cover the frames, points the other way or is not in newtons.
    """
    if angle is None:
        angle = math.radians(recording.info.angle)
    if places is None and recording.marker_places is not None:
        places = np.asarray(recording.marker_places, np.float64)
    try:
        return _pull(recording, angle, places, without_force)
    except ValueError as error:
        raise ValueError(f"recording {recording.info.name}: {error}") from error


def stacked(pulls: list[Pull]) -> Pull:
    """Several pulls as one, with a leading axis for `jax.vmap`.

    Raises `ValueError` when their shapes differ or only some have a force.
    """
    if not pulls:
        raise ValueError("no recordings: one stretching is needed at least")
    if len({pull.force is None for pull in pulls}) > 1:
        raise ValueError("some recordings have a force and some not: leave it out of all, or none")
    shapes = {pull.displacement.shape for pull in pulls}
    if len(shapes) > 1:
        raise ValueError(
            f"recordings must have as many frames and markers, found (frame, marker, axis) "
            f"{sorted(shapes)}: leave frames out"
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *pulls)


def _pull(recording, angle, places, without_force) -> Pull:
    sheet = recording.info.sheet
    size = np.asarray(sheet.size)
    axes = np.array([sheet.warp, sheet.weft, np.cross(sheet.warp, sheet.weft)])
    first, last = recording.info.frames_used
    times = np.asarray(recording.times, np.float64)[first : last + 1]
    _check_times(times)
    if recording.markers is None or recording.markers_seen is None:
        raise ValueError(
            "no markers: a stretching needs them in each frame "
            "(r2s.recordings.readers.markers.track)"
        )
    seen = np.asarray(recording.markers_seen)[first : last + 1]
    _check_seen(seen, first)
    world = np.asarray(recording.markers, np.float64)[first : last + 1]
    local = (world - np.asarray(sheet.origin)) @ axes.T
    places = _grid(size, seen.shape[1]) if places is None else np.asarray(places, np.float64)
    _check_places(places, size, seen.shape[1])
    displacement = local[..., :2] - places
    _check_on_sheet(displacement, local[..., 2], seen, places, min(size))
    near, far = _clamps(recording, times, axes, size)
    force = None
    if not without_force:
        force = _force(recording, times, axes[0])
        _check_unit(force, far[0][:, 0] - near[0][:, 0], size)
    down = axes @ np.array([0.0, 0.0, -GRAVITY])
    return Pull(
        size=_array(size),
        angle=_array(angle),
        places=_array(places),
        displacement=_array(np.where(seen[..., None], displacement, 0)),
        seen=jnp.asarray(seen),
        times=_array(times - times[0]),
        near=Clamp(*map(_array, near)),
        far=Clamp(*map(_array, far)),
        force=None if force is None else _array(force),
        gravity=_array(down[:2]),
        normal=_array(abs(down[2])),
    )


def _array(value) -> Array:
    return jnp.asarray(value, float)


def _check_times(times: np.ndarray) -> None:
    if len(times) < FEWEST_FRAMES:
        raise ValueError(
            f"{len(times)} frames: at least {FEWEST_FRAMES} are needed for an acceleration"
        )
    steps = np.diff(times)
    if not (steps > 0).all():
        at = int((~(steps > 0)).argmax())
        raise ValueError(
            f"times must increase, found {times[at]:g} s in frame {at}, then {times[at + 1]:g} s: "
            "sort the frames"
        )
    if steps.max() - steps.min() > 0.01 * steps.mean():
        raise ValueError(
            f"frames must be evenly spaced, found {steps.min():g} to {steps.max():g} s: resample"
        )


def _check_seen(seen: np.ndarray, first: int) -> None:
    never = np.flatnonzero(~seen.any(axis=0))
    if len(never):
        raise ValueError(f"marker {never[0]} is seen in no frame ({len(never)} such): leave it out")
    share = seen.mean(axis=1)
    if share.min() < FEWEST_SEEN:
        frame = int(share.argmin())
        raise ValueError(
            f"frame {frame + first}: {seen[frame].sum()} of {seen.shape[1]} markers are seen, at "
            f"least {FEWEST_SEEN:.0%} are needed: track them again, or leave the frame out"
        )


def _grid(size: np.ndarray, count: int) -> np.ndarray:
    """Places [m] of markers in a square grid, each in the middle of its cell."""
    side = round(count**0.5)
    if side * side != count:
        raise ValueError(
            f"{count} markers are no square grid: give `places` [m], where they are on the sheet"
        )
    along = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2) * size


def _check_places(places: np.ndarray, size: np.ndarray, count: int) -> None:
    if places.shape != (count, 2):
        raise ValueError(f"places must be ({count}, 2) [m], one a marker, found {places.shape}")
    outside = np.flatnonzero(((places < 0) | (places > size)).any(axis=1))
    if len(outside):
        raise ValueError(
            f"marker {outside[0]} has its place at {places[outside[0]]} m, not on the sheet of "
            f"{size[0]:g} x {size[1]:g} m ({len(outside)} such): are the places in metres?"
        )


def _check_on_sheet(displacement, height, seen, places, side: float) -> None:
    marker = int(np.argmax(np.where(seen[0], np.linalg.norm(displacement[0], axis=-1), 0)))
    off = np.linalg.norm(displacement[0, marker])
    if off > OFF_PLACE * side:
        found = 1e3 * (places[marker] + displacement[0, marker])
        raise ValueError(
            f"frame 0: marker {marker} is at {found.round(1)} mm on the sheet, its place is "
            f"{(1e3 * places[marker]).round(1)} mm: not on the sheet at rest, in another order, or "
            "not in metres"
        )
    away = np.where(seen, np.abs(height), 0)
    if away.max() > OFF_PLANE * side:
        frame, marker = np.unravel_index(away.argmax(), away.shape)
        raise ValueError(
            f"frame {frame}: marker {marker} is {1e3 * away.max():.1f} mm out of the sheet's plane,"
            f" at most {1e3 * OFF_PLANE * side:.1f} mm: the sheet must stay flat"
        )


def _clamps(recording: Recording, times: np.ndarray, axes: np.ndarray, size: np.ndarray):
    """Displacement, velocity and acceleration of both clamps, by cubic splines of their path."""
    held = recording.info.sheet.held
    if set(held) != {"origin", "weft", "warp", "opposite"}:
        raise ValueError(f"a stretching is clamped at four corners, this sheet is held at {held}")
    path = np.asarray(recording.handle_path, np.float64) @ axes[:2].T
    start = np.asarray(recording.info.sheet.origin) @ axes[:2].T
    corners = {"origin": (0, 0), "weft": (0, 1), "warp": (1, 0), "opposite": (1, 1)}
    knots = np.asarray(recording.handle_times, np.float64)
    moved = {}
    for i, name in enumerate(held):
        at = path[:, i] - start - np.array(corners[name]) * size
        at = np.stack([np.interp(times, knots, axis) for axis in at.T], axis=1)
        moved[name] = CubicSpline(times, at, bc_type="not-a-knot")
    ends = []
    for pair in (("origin", "weft"), ("warp", "opposite")):
        derivatives = [[moved[name](times, order) for name in pair] for order in range(3)]
        if np.max(np.abs(np.subtract(*derivatives[0]))) > 1e-3 * min(size):
            raise ValueError(f"the clamp from {pair[0]} to {pair[1]} turns: it must go straight")
        ends.append([np.mean(both, axis=0) for both in derivatives])
    return ends


def _force(recording: Recording, times: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The force [N] along the pull at the times of the frames."""
    if recording.force is None or recording.force_times is None:
        raise ValueError(
            "no force: without it only ratios of stiffness are identifiable, not their scale; add "
            "the load cell's log (r2s.recordings.readers.force_log), or take the pull with "
            "r2s.estimation.pinn.pulls.pull_from(recording, without_force=True)"
        )
    force = np.asarray(recording.force, np.float64)
    force = force @ along if force.ndim == 2 else force
    clock = np.asarray(recording.force_times, np.float64)
    check_covered(clock, times)
    return np.interp(times, clock, force)


def _check_unit(force: np.ndarray, pulled: np.ndarray, size: np.ndarray) -> None:
    """Raise `ValueError` when force over stretch is not the stiffness of any fabric."""
    stretch = pulled / size[0]
    if np.ptp(stretch) < 1e-3:
        raise ValueError(
            f"the clamps move apart by {1e3 * np.ptp(pulled):.2g} mm: no stretching, or not [m]"
        )
    stiffness = float(np.polyfit(stretch, force / size[1], 1)[0])
    if -stiffness > STIFFNESSES[0]:
        raise ValueError(
            f"the force on the pulled clamp falls while it is pulled ({stiffness:.3g} N/m): it "
            "must be positive along the pull"
        )
    if not STIFFNESSES[0] <= stiffness <= STIFFNESSES[1]:
        raise ValueError(
            f"force and stretch give {stiffness:.3g} N/m, fabrics have {STIFFNESSES[0]:g} to "
            f"{STIFFNESSES[1]:g}: is the force in newtons, and the path in metres?"
        )
