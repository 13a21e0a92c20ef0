"""Scenarios: a sheet at rest, what holds it, how that moves, and which frames count."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.cloth import Cloth
from r2s.fabric import Fabric
from r2s.mesh import Mesh, corner, rectangle
from r2s.physics.air import Air
from r2s.physics.contact import Table
from r2s.recording import Recording, SheetPlacement
from r2s.scene import Control, Scene, along_path
from r2s.solver import Trajectory, simulate

CLEARANCE = 1e-3  # [m], between the table and a sheet that lies on it
LEAD_IN = 0.5  # [s], in which the grippers go from the sheet at rest to where their path begins
MAX_STEP = 0.025  # [s]: 1 mm from the limit of small steps in a lift of 2.5 s, by measurement


class Scenario(eqx.Module):
    """An experiment, for any fabric. Its arrays are traced: one compilation serves all recordings
    of as many frames and knots.

    - `scene`: sheet, table, air, held vertices.
    - `start`: positions at rest, [m].
    - `path`, `path_times`: of the held vertices, [m] and [s].
    - `first_time`: of the first frame, [s].
    - `interval`: between frames, [s].
    - `num_frames`, `lead_in`: frames that count from the first, and frames simulated before it.
    - `substeps`: steps between frames, from `steps_between`.
    """

    scene: Scene
    start: Float[Array, "vertex 3"]
    path: Float[Array, "knot handle 3"]
    path_times: Float[Array, " knot"]
    first_time: Float[Array, ""]
    interval: float = eqx.field(static=True)
    num_frames: int = eqx.field(static=True)
    lead_in: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def controls(self, substeps: int) -> Control:
        """What the grippers do at the end of every substep, axes (frame, substep)."""
        frames = self.num_frames + self.lead_in - 1  # the first state needs no step
        steps = jnp.arange(1, frames * substeps + 1) / substeps - self.lead_in
        handles = along_path(
            self.first_time + self.interval * steps.astype(float), self.path_times, self.path
        )
        return Control(
            handles.reshape(frames, substeps, *self.path.shape[1:]),
            jnp.zeros((frames, substeps, 3), float),
        )


def from_placement(
    sheet: SheetPlacement,
    table_height: float,
    path: Float[Array, "knot handle 3"],
    path_times: Float[Array, " knot"],
    times: Float[np.ndarray, " frame"],
    shape: tuple[int, int] = (9, 9),
) -> Scenario:
    """A scenario for a rectangular sheet that lies on a table, held at named corners.

    `path` [m] and `path_times` [s] are the grippers', `times` [s] the frames', `shape` the
    vertices along warp and weft. Before the first frame the grippers go from the sheet's corners
    to where the path begins. Raises `ValueError` when the frames are not evenly spaced.
    """
    times = np.asarray(times)
    intervals = np.diff(times)
    interval = float(np.mean(intervals)) if len(times) > 1 else 1.0
    if np.any(np.abs(intervals - interval) > 1e-3 * interval):
        raise ValueError(
            f"frames must be evenly spaced in time, got {intervals.min():g} to "
            f"{intervals.max():g} s between them: resample the recording"
        )
    interval = round(interval, 9)  # so that float32 times of one rate compile once
    mesh = rectangle(sheet.size, shape)
    axes = np.array([sheet.warp, sheet.weft])
    start = np.asarray(sheet.origin) + np.asarray(mesh.rest) @ axes
    start[:, 2] = np.maximum(start[:, 2], table_height + CLEARANCE)
    held = np.array([corner(shape, name) for name in sheet.held])
    lead_in = math.ceil(LEAD_IN / interval)
    begin = min(times[0], float(path_times[0]))
    knots = jnp.asarray([begin - lead_in * interval, begin - lead_in * interval / 2], float)
    at_rest = jnp.asarray(start[held], float)
    return Scenario(
        scene=Scene(mesh, jnp.asarray(held), Table.make(table_height), Air.make()),
        start=jnp.asarray(start, float),
        path=jnp.concatenate([at_rest[None], path[:1], path]),
        path_times=jnp.concatenate([knots, path_times]),
        first_time=jnp.asarray(times[0], float),
        interval=interval,
        num_frames=len(times),
        lead_in=lead_in,
        substeps=steps_between(interval, mesh, np.asarray(path), np.asarray(path_times)),
    )


def steps_between(
    interval: float,
    mesh: Mesh,
    path: Float[np.ndarray, "knot handle 3"],
    path_times: Float[np.ndarray, " knot"],
) -> int:
    """How many steps to make in an interval [s]: the least such that none is above `MAX_STEP`, and
    that no gripper goes farther in one than the shortest edge of the mesh is long.

    The fabric does not limit the step: the formula is stable for any stiffness, and what is faster
    than the step is damped.
    """
    corners = np.asarray(mesh.rest)[np.asarray(mesh.faces)]
    edge = np.min(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1))
    moved = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    speeds = moved / np.maximum(np.diff(path_times), 1e-9)[:, None]
    fastest = float(np.max(speeds, initial=0.0))
    longest = min(MAX_STEP, edge / fastest) if fastest > 0 else MAX_STEP
    return math.ceil(interval / longest - 1e-9)


def from_recording(recording: Recording, shape: tuple[int, int] = (9, 9)) -> Scenario:
    """The scenario of a recording: its sheet, table, gripper path and frame times."""
    info = recording.info
    return from_placement(
        info.sheet,
        info.table_height,
        recording.handle_path,
        recording.handle_times,
        np.asarray(recording.times),
        shape,
    )


def motion(scenario: Scenario, fabric: Fabric, max_step: float | None = None) -> Trajectory:
    """How a fabric moves in a scenario: positions [m] at its frames.

    Steps of equal size fill the time between frames: the scenario's, or as many as it takes that
    none is above `max_step` [s].
    """
    substeps = scenario.substeps
    if max_step is not None:
        substeps = math.ceil(scenario.interval / max_step - 1e-9)
    solver = Cloth(scenario.scene, scenario.interval / substeps)
    moved = simulate(solver, fabric, solver.init(scenario.start), scenario.controls(substeps))
    skipped = scenario.lead_in - 1
    return Trajectory(moved.x[skipped:], moved.ok[skipped:])
