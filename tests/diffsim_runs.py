"""Runs of another simulator, DiffSim (Qiao et al. 2020), as motions to estimate from and judge by,
and what a fabric estimated from them predicts.

DiffSim let a sheet of 1 m fall, held by a corner or two or by an edge, and blew at it. A run there
is a linearised backward-Euler step of 10 ms after the other: it damps like a damping time of 10 ms,
and a falling sheet is where it should be 5 ms later. So damping is estimated along.
"""

import json
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from folders import SHARED
from jaxtyping import Float, Int, PRNGKeyArray

from r2s._util.units import GRAVITY
from r2s.environment.air import Air
from r2s.environment.scene import Scene
from r2s.estimation.estimate import Estimate
from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.problem import Clouds, NuisancePrior, Problem
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.mesh import Mesh
from r2s.scenarios.scenario import BRAKE, Scenario, rollout

DATA = SHARED / "data" / "diffsim_reference"
LIFT, REST, EDGE = "lift1_{}_9_dt10", "rest_{}_9_dt40", "edge_{}_9_dt40"
WIND = "hang2wind_{}_9_dt10"
EXACT = NuisancePrior(0.0, 0.0)
FRAME = 0.04  # [s] between frames
COUNT = 10  # of a motion's frames count where nothing else is said, the first at 0.04 s
STEPS, REST_STEPS = 4, 2  # of r2s in a frame
NOISE = 1e-3  # [m], of the clouds
SETTLING = 90  # frames in which a braked sheet comes to rest

_motion = eqx.filter_jit(rollout)


class Made(NamedTuple):
    """A run of the other simulator.

    - `mesh`, `held`: the sheet and its pinned vertices. `start`: positions at rest, [m].
    - `times`, `x`, `handles`: of the frames [s], vertices and handles in them [m].
    - `told`: its settings.
    """

    mesh: Mesh
    held: Int[np.ndarray, " pinned"]
    start: Float[np.ndarray, "vertex 3"]
    times: Float[np.ndarray, " frame"]
    x: Float[np.ndarray, "frame vertex 3"]
    handles: Float[np.ndarray, "frame gripper 3"]
    told: dict


def read(folder: Path, name: str) -> Made:
    """A run. Raises `FileNotFoundError` without its files, `ValueError` for air not as in r2s."""
    path = folder / f"{name}.npz"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such trajectory")
    told, arrays = json.loads(path.with_suffix(".json").read_text()), np.load(path)
    if told["wind"]["drag"] != 0:
        raise ValueError(f"{path}: expected no drag along the faces, got {told['wind']['drag']}")
    return Made(
        Mesh.make(arrays["rest_uv"], arrays["faces"].astype(int)),
        arrays["handle_vertices"].astype(int),
        arrays["initial_position"],
        arrays["time"],
        arrays["position"],
        arrays["handle_target"],
        told,
    )


def first_acceleration(made: Made) -> Float[np.ndarray, "vertex 3"]:
    """Of a sheet that is let go at rest [m/s^2]: gravity and wind, but for the pinned vertices."""
    faces = np.asarray(made.mesh.faces)
    corners = made.start[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2  # [m^2]
    area = np.linalg.norm(normal, axis=1)
    flow = normal @ np.asarray(made.told["wind"]["velocity"], float) / area
    thrust = (made.told["wind"]["density"] * np.abs(flow) * flow)[:, None] * normal
    force = np.zeros_like(made.start)
    np.add.at(force, faces, np.repeat(thrust[:, None] / 3, 3, axis=1))
    mass = made.told["material_json"]["density"] * np.asarray(made.mesh.vertex_area)
    acceleration = force / mass[:, None] - np.array([0.0, 0.0, GRAVITY])
    acceleration[made.held] = 0
    return acceleration


def scenario_of(
    made: Made, at_rest: bool = False, count: int = COUNT, steps: int = STEPS
) -> Scenario:
    """The run as an experiment of r2s: `count` frames, the first one `FRAME` after the start, in
    `steps` each.

    With `at_rest` they come after the sheet, which falls from where it starts, was braked for
    `SETTLING` frames, in `REST_STEPS` each.
    """

    def array(value):
        return jnp.asarray(value, float)

    wind = np.asarray(made.told["wind"]["velocity"], float)
    handles, times = np.array(made.handles), made.times
    handles[0] = made.start[made.held]
    if at_rest:
        handles, times = np.repeat(handles[:1], 2, axis=0), np.array([0.0, 1.0])
    lead_in = SETTLING if at_rest else 1
    air = Air.make(made.told["wind"]["density"], drag_coefficient=2.0, friction_coefficient=0.0)
    return Scenario(
        scene=Scene(made.mesh, made.held, air=air),
        start=array(made.start),
        path=array(handles),
        path_times=array(times),
        first_time=array(lead_in * FRAME),
        interval=FRAME,
        num_frames=count,
        lead_in=lead_in,
        substeps=REST_STEPS if at_rest else steps,
        wind=array(np.stack([wind, wind])),
        wind_times=array([0.0, 1.0]),
        brake=array(BRAKE) if at_rest else None,
        acceleration=array(first_acceleration(made)),
    )


def truth(
    made: Made, at_rest: bool = False, count: int = COUNT
) -> Float[np.ndarray, "frame vertex 3"]:
    """Its vertices in the frames that count [m]: after the start, or again and again at rest.

    Raises `ValueError` for frames that are too few, or not `FRAME` apart.
    """
    if at_rest:
        return np.repeat(made.x[-1:], count, axis=0)
    expected, found = FRAME * np.arange(1, count + 1), made.times[1 : count + 1]
    if len(found) < count or np.max(np.abs(found - expected)) > 1e-9:
        raise ValueError(f"expected {count} frames {FRAME} s apart, got times {found[:3]}... s")
    return made.x[1 : count + 1]


def sampled(
    x: Float[np.ndarray, "frame vertex 3"],
    mesh: Mesh,
    number: int,
    key: PRNGKeyArray,
    noise: float = NOISE,
) -> Clouds:
    """Points on a sheet, evenly spread over its area at rest, with noise [m] in every direction."""
    which, where, off = jax.random.split(key, 3)
    frames = x.shape[0]
    share = mesh.area / jnp.sum(mesh.area)
    face = jax.random.choice(which, mesh.faces.shape[0], (frames, number), p=share)
    weights = jax.random.dirichlet(where, jnp.ones(3, float), (frames, number))
    corners = jnp.asarray(x, float)[jnp.arange(frames)[:, None, None], mesh.faces[face]]
    points = jnp.einsum("fpk,fpki->fpi", weights, corners)
    points = points + noise * jax.random.normal(off, points.shape, float)
    return Clouds(points, jnp.ones((frames, number), bool))


def predicted(made: Made, fabric: Fabric, at_rest: bool = False) -> np.ndarray:
    """The vertices (frame, vertex, 3) [m] that a fabric would show in the frames that count.

    Raises `RuntimeError` when the run failed.
    """
    moved = _motion(scenario_of(made, at_rest), fabric)
    if not bool(jnp.all(moved.ok)):
        raise RuntimeError(f"{made.told['name']}: {moved.explain()}")
    return np.asarray(moved.x, np.float64)


def errors(found: np.ndarray, made: np.ndarray) -> np.ndarray:
    """Root mean square over the vertices [m], of each frame."""
    return np.sqrt(np.mean(np.sum((found - made) ** 2, axis=-1), axis=1))


def worst_error(name: str, fabric: Fabric, at_rest: bool = False) -> float:
    """The error of a fabric in a run, in the worst frame [% of the side]."""
    made = read(DATA, name)
    each = errors(predicted(made, fabric, at_rest), truth(made, at_rest))
    return 100 * float(np.max(each)) / float(np.max(np.ptp(np.asarray(made.mesh.rest), axis=0)))


def estimated(fabric: str, number: int, budget: Budget) -> Estimate:
    """The fabric of known density from clouds, of `number` points, of its lift and rest shape."""
    problems = []
    for i, (name, at_rest) in enumerate(((LIFT, False), (REST, True))):
        made = read(DATA, name.format(fabric))
        space = OrthotropicSpace.make(made.told["material_json"]["density"])
        key = jax.random.fold_in(jax.random.key(0), i)
        clouds = sampled(truth(made, at_rest), made.mesh, number, key)
        scenario, frames = scenario_of(made, at_rest), tuple(range(COUNT))
        problems.append(Problem(scenario, space, frames, clouds, nuisance_prior=EXACT))
    return descend(tuple(problems), budget, key=jax.random.key(1))
