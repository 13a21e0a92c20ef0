"""Scenarios: a sheet at rest, its grippers and their motion, and the frames that count."""

import dataclasses
import functools
import math
from hashlib import sha256
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s._util.arrays import is_traced
from r2s.environment.air import Fan
from r2s.environment.scene import Control, Scene, along_path
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import TurnedMembrane
from r2s.mesh.mesh import Mesh, corner, rectangle
from r2s.mesh.mesh import resized as resized_mesh
from r2s.recordings.recording import (
    MAX_STEP,
    Recording,
    SheetPlacement,
    first_motion,
    interpolated,
)
from r2s.scenarios.paths import Route, ease
from r2s.scenarios.sheet_solver import Braked, SheetSolver
from r2s.solvers.implicit.cloth import MAX_ITERATIONS, ImplicitCloth, prepare_mesh
from r2s.solvers.simulate import Solution, between, simulate

CLEARANCE = 1e-3  # [m], between the table and a sheet that lies on it
LEAD_IN = 0.5  # [s], in which the grippers go from the sheet at rest to where their path begins
GRID = 0.0125  # [s], at least a step: between the states that frames at uneven times lie between
EVEN = 1e-3  # of the interval, by which frames may deviate from even times
SETTLING = 3.0  # [s], in which a sheet that hangs comes to rest before the first frame
BRAKE = 8.0  # [1/s], mass damping meanwhile: of a sheet of 0.45 m 4e-11 of the energy remain
ITERATIONS = 1000  # of Newton's method, of a hanging sheet: 33 x 33 vertices may need over 500
BOW = 0.01  # [m], by which a hanging sheet starts out of its plane, so that it buckles to one side
GUST = 0.5  # [s], in which a wind rises from zero
JET = (1 / 3, 1 / 4)  # radius and edge of a fan's jet, of the sheet's shorter side
CLAMPS = (("origin", "weft"), ("warp", "opposite"))  # sides that a stretching holds
BAR = (("origin", "warp"),)  # the side that a swing holds
CLAMPED = {"stretching": CLAMPS, "swing": BAR}  # sides that are held in a scenario


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the vertices and elements of a mesh are joined, whatever its size: hashable.

    Orders of elimination and searches for contacts follow from it alone, so that a solver can be
    made for a scenario that is traced. `mesh` has this layout, and must not be traced.
    """

    mesh: Mesh = dataclasses.field(compare=False, repr=False)
    key: str = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        rest = np.asarray(self.mesh.rest)
        extent = np.ptp(rest, axis=0)
        ranks = [np.unique(np.round(axis, 6), return_inverse=True)[1] for axis in (rest / extent).T]
        leaves = map(np.asarray, jax.tree.leaves(self.mesh))
        parts = [*ranks, *(leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.integer))]
        arrays = [np.asarray(part, np.int32) for part in parts]
        key = np.argmax(extent), *((array.shape, array.tobytes()) for array in arrays)
        object.__setattr__(self, "key", sha256(repr(key).encode()).hexdigest())


class Scenario(eqx.Module):
    """An experiment, for any fabric. Its arrays are traced: one compilation serves all recordings
    of as many frames and knots.

    - `scene`: sheet, table, air, fan, pinned vertices.
    - `start`: positions at rest, [m].
    - `path`, `path_times`: of the pinned vertices, [m] and [s].
    - `first_time`: of the first frame, [s].
    - `interval`: between frames, [s].
    - `num_frames`, `lead_in`: frames that count from the first, and frames simulated before it.
    - `substeps`: steps between frames, from `steps_between`.
    - `frame_times`: [s], of frames that are not evenly spaced, or begin after the motion. They are
      interpolated between those of the four fields above, see `at_frames`. None: they are these.
    - `wind`, `wind_times`: of the air, [m/s] and [s], linear between; None: still air.
    - `brake`: mass damping [1/s] before the first frame, beside the fabric's; None: none.
    - `acceleration`: at the start, [m/s^2], of a sheet that is let go there; None: it is at rest.
    - `turn`: from the sheet's first side to the warp, [rad]; None: it lies along it.
    - `self_contact`: whether the sheet does not pass through itself.
    - `layout`: of the mesh; by default it follows from that, which must then not be traced.
    """

    scene: Scene
    start: Float[Array, "vertex 3"]
    path: Float[Array, "knot gripper 3"]
    path_times: Float[Array, " knot"]
    first_time: Float[Array, ""]
    interval: float = eqx.field(static=True)
    num_frames: int = eqx.field(static=True)
    lead_in: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    wind: Float[Array, "gust 3"] | None = None
    wind_times: Float[Array, " gust"] | None = None
    brake: Float[Array, ""] | None = None
    acceleration: Float[Array, "vertex 3"] | None = None
    turn: Float[Array, ""] | None = None
    frame_times: Float[Array, " frame"] | None = None
    self_contact: bool = eqx.field(static=True, default=False)
    layout: Layout | None = eqx.field(static=True, default=None)

    def __post_init__(self) -> None:
        if self.layout is None:
            self.layout = Layout(self.scene.mesh)

    @property
    def places(self) -> Float[Array, " frame"]:
        """Where the frames are among those that are simulated, which count from 0."""
        if self.frame_times is None:
            return jnp.arange(self.num_frames).astype(float)
        return (self.frame_times - self.first_time) / self.interval

    def controls(self, substeps: int) -> Control:
        """What grippers and air do at the end of every step, of `substeps` between frames."""
        frames = self.num_frames + self.lead_in - 1  # the first state needs no step
        steps = jnp.arange(1, frames * substeps + 1) / substeps - self.lead_in
        times = self.first_time + self.interval * steps.astype(float)
        path = along_path(times, self.path_times, self.path)
        if self.wind is None or self.wind_times is None:
            return Control(path)
        return Control(path, along_path(times, self.wind_times, self.wind[:, None])[:, 0])


class Experiment(NamedTuple):
    """The motion of a sheet's grippers and the wind, for any fabric and any solver.

    - `sheet`: where it is at rest, and which corners the grippers hold; `route`: their path.
    - `times`: of the frames, [s]. `frames_used`: the first and the last frame that count.
    - `wind`: of a fan in front of the sheet's middle, from the first frame on, [m/s]; None: none.
    - `clamps`: pairs of pinned corners; all of the side between them is held, straight and evenly
      spread.
    - `table_height`: [m].
    """

    name: str
    sheet: SheetPlacement
    route: Route
    times: Float[np.ndarray, " frame"]
    frames_used: tuple[int, int]
    wind: tuple[float, float, float] | None = None
    clamps: tuple[tuple[str, str], ...] = ()
    table_height: float = 0.0

    def scenario(
        self,
        shape: tuple[int, int] = (9, 9),
        self_contact: bool = False,
        elements: str = "wrinkling",
    ) -> Scenario:
        """On a mesh of `shape` vertices along warp and weft, made of `elements`
        (`r2s.mesh.mesh.rectangle`); with `self_contact` it does not pass through itself.

        Before the first frame, or before a gripper moves where that is earlier, the grippers go
        from the sheet's corners to where the path begins; a sheet that hangs also comes to rest,
        braked by `BRAKE` for `SETTLING`. Frames may come at any times.
        """
        sheet, times = self.sheet, np.asarray(self.times, np.float64)
        route = Route(*(np.asarray(part, np.float64) for part in self.route))
        start_time, route = _from_rest(route, float(times[0]))
        path_times, path = (jnp.asarray(part, float) for part in route)
        interval, is_even = _interval(times)
        # whole intervals before the first frame, so that steps end at frames where they can
        ahead = math.ceil((times[0] - start_time) / interval - EVEN)
        start_time, is_even = float(times[0]) - ahead * interval, is_even and not ahead
        mesh = rectangle(sheet.size, shape, elements)
        start, hangs = _at_rest(sheet, np.asarray(mesh.rest), self.table_height)
        pinned, shares = _grip(sheet, shape, self.clamps)
        if self.clamps:
            path = jnp.einsum("vh,khi->kvi", jnp.asarray(shares, float), path)
        substeps = steps_between(interval, mesh, np.asarray(path), np.asarray(path_times))
        num_frames, frame_times = len(times), None
        if not is_even:
            step = interval / substeps
            substeps = max(int(GRID / step), 1)
            interval = substeps * step
            num_frames = math.ceil((times[-1] - start_time) / interval - 1e-6) + 1
            frame_times = jnp.asarray(times, float)
        lead_in = math.ceil((SETTLING if hangs else LEAD_IN) / interval)
        first, before = min(start_time, float(path_times[0])), lead_in * interval
        knots = jnp.asarray([first - before, first - before / 2], float)
        at_rest = jnp.asarray(start[pinned], float)
        wind = self.wind if self.wind is not None and any(self.wind) else None
        gust, gust_times = (None, None) if wind is None else _gust(wind, float(times[0]))
        fan = None if wind is None else _fan(sheet, wind)
        return Scenario(
            scene=Scene(mesh, pinned, self.table_height, fan=fan),
            start=jnp.asarray(start, float),
            path=jnp.concatenate([at_rest[None], path[:1], path]),
            path_times=jnp.concatenate([knots, path_times]),
            first_time=jnp.asarray(times[0] if is_even else start_time, float),
            interval=interval,
            num_frames=num_frames,
            lead_in=lead_in,
            substeps=substeps,
            wind=gust,
            wind_times=gust_times,
            brake=jnp.asarray(BRAKE, float) if hangs else None,
            frame_times=frame_times,
            self_contact=self_contact,
        )


def _at_rest(
    sheet: SheetPlacement, rest: np.ndarray, table_height: float
) -> tuple[np.ndarray, bool]:
    """Where the vertices start, [m], and whether the sheet hangs."""
    axes = np.array([sheet.warp, sheet.weft])
    normal = np.cross(*axes)
    hangs = bool(abs(normal[2]) < 0.9)
    start = np.asarray(sheet.origin) + rest @ axes
    if hangs:
        bowed = np.sin(np.pi * rest / np.asarray(sheet.size)).prod(axis=1)
        start = start + BOW * bowed[:, None] * normal
    start[:, 2] = np.maximum(start[:, 2], table_height + CLEARANCE)
    return start, hangs


def _from_rest(route: Route, first: float) -> tuple[float, Route]:
    """When the sheet is last at rest, [s]: at the first frame, at time `first`, or where a gripper
    begins to move before that; and the route from there on, without jitter before it moves."""
    begin = first_motion(*route).begin
    start, (times, path) = min(begin, first), route
    if np.isfinite(begin):
        still = interpolated(np.array([begin]), times, path)
        path = np.where((times < begin)[:, None, None], still, path)
    if not times[0] < start:
        return start, Route(times, path)
    left = times > start
    here = interpolated(np.array([start]), times, path)
    return start, Route(np.r_[start, times[left]], np.concatenate([here, path[left]]))


def _interval(times: Float[np.ndarray, " frame"]) -> tuple[float, bool]:
    """Between frames [s], and whether all are that; else of the even times that these are nearest
    to, some of them dropped. Rounded, so that recordings of one rate compile once."""
    if len(times) < 2:
        return 1.0, True
    intervals = np.diff(times)
    interval = float(np.mean(intervals))
    grid = times[0] + interval * np.arange(len(times))
    if np.all(np.abs(times - grid) <= EVEN * interval):
        return round(interval, 9), True
    short = float(np.quantile(intervals, 0.1))
    if short > max(GRID, interval / 4):
        numbers = np.cumsum(np.maximum(np.round(intervals / short), 1))
        interval = float(numbers @ (times[1:] - times[0]) / (numbers @ numbers))
    return float(f"{interval:.4g}"), False


def _grip(
    sheet: SheetPlacement, shape: tuple[int, int], clamps: tuple[tuple[str, str], ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The pinned vertices, and the share of each gripper in the place of each (vertex, gripper)."""
    corners = [corner(shape, name) for name in sheet.pinned]
    shares = dict(zip(corners, np.eye(len(corners)), strict=True))
    for pair in clamps:
        first, last = (corner(shape, name) for name in pair)
        side = np.arange(first, last + 1, 1 if last - first < shape[1] else shape[1])
        for vertex, along in zip(side, np.linspace(0, 1, len(side)), strict=True):
            shares[int(vertex)] = (1 - along) * shares[first] + along * shares[last]
    return np.array(list(shares)), np.array(list(shares.values()))


def _fan(sheet: SheetPlacement, wind: tuple[float, float, float]) -> Fan:
    """A jet through the middle of the sheet."""
    axes = np.array([sheet.warp, sheet.weft])
    middle = np.asarray(sheet.origin) + np.asarray(sheet.size) @ axes / 2
    radius, edge = (share * min(sheet.size) for share in JET)
    return Fan(*(jnp.asarray(part, float) for part in (middle, wind, radius, edge)))


def _gust(wind: tuple[float, float, float], begin: float):
    """A wind [m/s] that rises smoothly from `begin` [s] on, and its times [s]."""
    progress = np.linspace(0, 1, 13)
    risen = ease(progress)[:, None] * np.asarray(wind)
    return jnp.asarray(risen, float), jnp.asarray(begin + GUST * progress, float)


def steps_between(
    interval: float,
    mesh: Mesh,
    path: Float[np.ndarray, "knot gripper 3"],
    path_times: Float[np.ndarray, " knot"],
) -> int:
    """The least number of steps in an interval [s] such that none is above `MAX_STEP`, and no
    gripper goes farther in one than the shortest edge."""
    corners = np.asarray(mesh.rest)[np.asarray(mesh.faces)]
    edge = np.min(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1))
    moved = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    speeds = moved / np.maximum(np.diff(path_times), 1e-9)[:, None]
    fastest = float(np.max(speeds, initial=0.0))
    longest = min(MAX_STEP, edge / fastest) if fastest > 0 else MAX_STEP
    return math.ceil(interval / longest - 1e-9)


def from_recording(recording: Recording, shape: tuple[int, int] = (9, 9)) -> Scenario:
    """The scenario of a recording: its sheet, table, gripper path, wind and frame times.

    A "stretching" has the sides between its corners clamped, a "swing" the one along the bar.
    """
    info = recording.info
    route = Route(np.asarray(recording.gripper_times), np.asarray(recording.gripper_path))
    clamps = CLAMPED.get(info.scenario, ())
    given = info.sheet, route, np.asarray(recording.times), info.frames_used, info.wind
    scenario = Experiment(info.scenario, *given, clamps, info.table_height).scenario(shape)
    if not info.angle:
        return scenario
    return dataclasses.replace(scenario, turn=jnp.asarray(math.radians(info.angle), float))


def finely_saved(scenario: Scenario) -> Scenario:
    """The scenario with the same steps, of which more are kept (`GRID`): for frames that may lie
    between those of its own."""
    if scenario.frame_times is not None:
        return scenario
    steps, step = scenario.substeps, scenario.interval / scenario.substeps
    kept = max(k for k in range(1, steps + 1) if steps % k == 0 and (k == 1 or k * step <= GRID))
    times = scenario.first_time + scenario.interval * jnp.arange(scenario.num_frames).astype(float)
    return dataclasses.replace(
        scenario,
        interval=kept * step,
        num_frames=(scenario.num_frames - 1) * (steps // kept) + 1,
        lead_in=scenario.lead_in * (steps // kept),
        substeps=kept,
        frame_times=times,
    )


def as_cut(scenario: Scenario, fabric: Fabric) -> Fabric:
    """The fabric in the axes of the scenario's sheet, which may be cut at an angle to its warp.

    The membrane alone is turned: a stretched sheet is flat, so its bending does not count.
    """
    if scenario.turn is None:
        return fabric
    return dataclasses.replace(fabric, membrane=TurnedMembrane(fabric.membrane, scenario.turn))


def resized(scenario: Scenario, ratio: Float[Array, ""]) -> Scenario:
    """The scenario of a sheet `ratio` times as long and as wide, held where it is.

    Its pinned vertices stay where they were if there is one of them; several move apart at first.
    """
    pinned = scenario.start[scenario.scene.pinned]
    fixed = jnp.mean(pinned, axis=0, keepdims=True)

    def grown(places: Float[Array, "place 3"]) -> Float[Array, "place 3"]:
        return fixed + ratio * (places - fixed)

    scene = dataclasses.replace(scenario.scene, mesh=resized_mesh(scenario.scene.mesh, ratio))
    path = scenario.path.at[0].set(grown(pinned))
    return dataclasses.replace(scenario, scene=scene, start=grown(scenario.start), path=path)


def in_denser_air(part: Any, ratio: Float[Array, ""] | float) -> Any:
    """A scenario, or a solver of one, whose air has `ratio` times the density, and force."""
    return eqx.tree_at(
        lambda part: part.scene.air.density, part, replace_fn=lambda density: density * ratio
    )


def rollout(
    scenario: Scenario,
    fabric: Fabric,
    max_step: float | None = None,
    solver: SheetSolver | None = None,
    frames: Int[Array, ""] | int | None = None,
) -> Solution:
    """How a fabric moves in a scenario, at its frames; times are those of the frames. Between the
    frames that are simulated it is a cubic (`Scenario.frame_times`).

    By the implicit cloth, in the scenario's steps, or in so many that none is above `max_step` [s].
    Or by another `solver` of the same scene, whose step divides the time between frames, such as
    `r2s.scenarios.mpm_cloth`. `frames`: how many are simulated, which may be traced; the
    others repeat the last.
    """
    solver, substeps = stepped(scenario, max_step, solver)
    skipped, places = scenario.lead_in - 1, scenario.places
    if frames is not None and scenario.frame_times is not None:
        frames = jnp.ceil(places[frames - 1]).astype(int) + 1
    motion = simulate(
        solver,
        as_cut(scenario, fabric),
        begin(solver, scenario),
        scenario.controls(substeps),
        save_every=substeps,
        saves=None if frames is None else frames + skipped,
    )
    before = scenario.lead_in * scenario.interval - scenario.first_time
    saved = (part[skipped:] for part in (motion.x, motion.v, motion.times, motion.ok))
    x, v, times, ok = saved
    times = times - before
    if scenario.frame_times is not None:
        x, v = at_frames(scenario, x, v)
        times, ok = scenario.frame_times, ok[jnp.ceil(places).astype(int)]
    failed_at = motion.failed_at - before
    return Solution(x, v, times, motion.final_state, ok, motion.result, failed_at)


def at_frames(
    scenario: Scenario,
    x: Float[Array, "simulated vertex 3"],
    v: Float[Array, "simulated vertex 3"],
    delay: Float[Array, ""] | float = 0.0,
) -> tuple[Float[Array, "frame vertex 3"], Float[Array, "frame vertex 3"]]:
    """Positions [m] and velocities [m/s] at the frames of a scenario, from those that were
    simulated; or `delay` [s] before them."""
    return between(x, v, scenario.places - delay / scenario.interval, scenario.interval)


def stepped(
    scenario: Scenario, max_step: float | None = None, solver: SheetSolver | None = None
) -> tuple[SheetSolver, int]:
    """The solver of a motion, which brakes the sheet before its first frame; its steps per frame.

    The arguments are those of `rollout`. Raises `ValueError` when a solver's step does not fit, or
    `max_step` is not positive.
    """
    if solver is None:
        substeps = scenario.substeps
        if max_step is not None:
            if not max_step > 0:
                raise ValueError(f"max_step [s] must be positive, got {max_step}")
            substeps = math.ceil(scenario.interval / max_step - 1e-9)
        dt = scenario.interval / substeps
        x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        elimination, search = _prepared(scenario.layout, scenario.self_contact, x64)
        solver = ImplicitCloth(
            scenario.scene,
            dt,
            self_contact=search,
            max_iterations=MAX_ITERATIONS if scenario.brake is None else ITERATIONS,
            elimination=elimination,
        )
    else:
        if is_traced(solver.dt):
            raise ValueError("make an implicit solver in the function that is traced: its step is")
        dt = float(solver.dt)
        substeps = round(scenario.interval / dt)
        if abs(substeps * dt - scenario.interval) > 1e-6 * scenario.interval:
            raise ValueError(
                f"steps must fill the {scenario.interval:g} s between frames, got {dt:g} s"
            )
    if scenario.brake is None:
        return solver, substeps
    return Braked(solver, scenario.brake, scenario.lead_in * substeps, solver.dt), substeps


@functools.lru_cache(maxsize=16)
def _prepared(layout: Layout, self_contact: bool, x64: bool) -> Any:
    """How the cloth solves its equations and finds contacts, in integers of 64 bits or of 32."""
    del x64
    return prepare_mesh(layout.mesh, self_contact)


def begin(solver: SheetSolver, scenario: Scenario) -> Any:
    """The state of a solver from `stepped` at the start of a scenario, without velocity."""
    return solver.init(scenario.start, None, scenario.acceleration)
