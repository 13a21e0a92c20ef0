"""Synthetic recordings: a known fabric, moved by a solver and seen by cameras.

An estimate with the solver, mesh and step of the recording tests the estimator, not the solver: the
error on a real fabric is larger. `record` takes any scenario, solver, mesh and step.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.compilation import compile_once
from r2s.materials.fabric import Fabric
from r2s.mesh.surface import nearest, sample
from r2s.recordings.cameras import Camera
from r2s.recordings.recording import Recording, RecordingInfo, corner, make_recording
from r2s.scenarios.energy import EnergyBalance, clamp_force, energy_balance
from r2s.scenarios.scenario import Scenario, SheetSolver, at_frames, rollout
from r2s.scenarios.standard import ALL_CORNERS, SIDE, Experiment
from r2s.solvers.mpm.sheet import longest_edge
from r2s.solvers.simulate import Solution

SPACING = SIDE * math.sqrt(2) / 80  # [m], between samples of the surface
POINTS = 2000  # a frame
NOISE = 1e-3  # [m], standard deviation
OUTLIERS = 0.01  # of the points
MARGIN = 0.004  # [m] above the table, below which a camera cannot tell sheet from table
MARKERS = 9  # squared, printed on a sheet that is stretched
MARKER_NOISE = 2e-4  # [m]
FORCE_NOISE = 0.01  # [N]


class Sensing(NamedTuple):
    """How cameras see a motion.

    - `cameras`: a point is recorded that one of them sees; none: all of the surface is.
    - `region`: two corners of the box in which outliers lie, [m].
    - `points`: at most, in a frame.
    - `noise`: standard deviation of each coordinate, [m].
    - `outliers`: fraction of the points, [-]; three at least, unless 0.
    - `margin`: above the table, below which no point is recorded, [m].
    """

    cameras: tuple[Camera, ...]
    region: tuple[tuple[float, float, float], tuple[float, float, float]]
    points: int = POINTS
    noise: float = NOISE
    outliers: float = OUTLIERS
    margin: float = MARGIN


def sensing(experiment: Experiment) -> Sensing:
    """Two depth cameras where they see most of an experiment's sheet, and the usual errors.

    For a sheet on the table, from the left and from above. For one that hangs, both from the side
    from which the wind blows. In a stretching the sheet is told from the table by its colour.
    """
    sheet, margin = experiment.sheet, MARGIN
    if sheet.weft[2] > -0.5:
        eyes, target = [(-0.5, -0.1, 0.5), (0.1, -0.4, 0.9)], (0.25, 0.25, 0.1)
        low, high = np.array([-0.1, -0.1, 0.0]), np.array([0.6, 0.6, 0.5])
        margin = -math.inf if experiment.name == "stretching" else MARGIN
    else:
        corners = np.array([corner(sheet, name) for name in ALL_CORNERS])
        middle = corners.mean(axis=0)
        eyes = middle + np.array([(-0.35, -1.1, 0.15), (0.55, -1.0, 0.4)])
        target = middle + np.array([0.0, 0.1, 0.0])
        low, high = corners.min(axis=0) - [0.1, 0.3, 0.1], corners.max(axis=0) + [0.1, 0.5, 0.1]
    cameras = tuple(Camera(jnp.asarray(eye, float), jnp.asarray(target, float)) for eye in eyes)
    return Sensing(cameras, (tuple(low.tolist()), tuple(high.tolist())), margin=margin)


WHOLE = Sensing((), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), 10_000, 0.0, 0.0, margin=-math.inf)
"""All of the surface without errors, for evaluation: 10,000 points a frame, as in the study."""


def record(
    experiment: Experiment,
    fabric: Fabric,
    name: str,
    trial: int = 1,
    *,
    seen: Sensing | None = None,
    shape: tuple[int, int] = (9, 9),
    max_step: float | None = None,
    self_contact: bool = False,
    solver: Callable[[Scenario, Fabric], SheetSolver] | None = None,
    motion: Solution | None = None,
    key: PRNGKeyArray,
) -> Recording:
    """Record a simulated experiment with a fabric; the same `key` gives the same recording.

    - `name`, `trial`: of the fabric and of the repetition.
    - `seen`: cameras and their errors; None: those of `sensing`.
    - `shape`: vertices along warp and weft. `max_step`: longest time step, [s].
    - `self_contact`: whether the sheet touches itself.
    - `solver`: makes another solver than the cloth, such as `r2s.scenarios.mpm_cloth`.
    - `motion`: that of these arguments, if known; a stretching, which also has markers and the
      force on the pulled clamp, is simulated in any case.

    Raises `RuntimeError` that says why when the simulation diverges, and `ValueError` for a motion
    of another shape.
    """
    scenario = experiment.scenario(shape, self_contact)
    made = None if solver is None else solver(scenario, fabric)
    measured: dict[str, Any] = {}
    if experiment.name == "stretching":
        balance = _energy_balance(scenario, fabric, max_step, made)
        x, _ = at_frames(scenario, balance.x, balance.v)
        measured = _measured(experiment, scenario, balance, x, key)
    else:
        known = _rollout(scenario, fabric, max_step, made) if motion is None else motion
        x = known.x
    if x.shape != (len(scenario.places), *scenario.start.shape):
        raise ValueError(
            f"expected a motion of {len(scenario.places)} frames and {len(scenario.start)} "
            f"vertices, got {x.shape}"
        )
    if not np.isfinite(x).all():
        why = (motion or _rollout(scenario, fabric, max_step, made)).explain()
        raise RuntimeError(f"the simulation of {name} {why}")
    seen = sensing(experiment) if seen is None else seen
    return seen_of(x, experiment, scenario, name, trial, seen, measured, key=key)


def seen_of(
    x: Float[Array, "frame vertex 3"],
    experiment: Experiment,
    scenario: Scenario,
    name: str,
    trial: int,
    seen: Sensing,
    measured: dict[str, Any] | None = None,
    *,
    key: PRNGKeyArray,
) -> Recording:
    """What cameras record of a known motion; arguments as in `record`.

    - `x`: positions of the vertices of `scenario`, which is `experiment` on a mesh, [m].
    - `measured`: what else there is, see `r2s.recordings.recording.make_recording`.
    """
    errors = f"camera noise {1e3 * seen.noise:g} mm, {seen.outliers:.0%} outliers"
    info = RecordingInfo(
        name=f"{experiment.name}_{name}{trial if trial > 1 else ''}",
        scenario=experiment.name,
        fabric=name,
        trial=str(trial),
        source=f"synthetic: {name}, {errors}",
        frames_used=experiment.frames_used,
        sheet=experiment.sheet,
        table_height=experiment.table_height,
        verified=None,
        wind=experiment.wind,
    )
    clouds = _clouds(x, scenario, seen, key)
    route = experiment.route
    return make_recording(
        clouds, experiment.times, route.path, route.times, info, **(measured or {})
    )


def _measured(
    experiment: Experiment, scenario: Scenario, balance: EnergyBalance, x, key: PRNGKeyArray
) -> dict[str, Any]:
    """The force on the pulled clamp and the markers of a stretching, with their errors."""
    key_markers, key_force = jr.split(jr.fold_in(key, 1))
    force = np.asarray(clamp_force(scenario, balance))
    return {
        "force": force + FORCE_NOISE * np.asarray(jr.normal(key_force, force.shape, float)),
        "force_times": experiment.times,
        "markers": markers_of(x, scenario, key_markers),
    }


_rollout = compile_once(rollout)
_energy_balance = compile_once(energy_balance)


def markers_of(x, scenario: Scenario, key, noise: float = MARKER_NOISE) -> np.ndarray:
    """Places [m] of a printed grid of markers in each frame, each in the middle of its cell, with
    `noise` [m]."""
    mesh = scenario.scene.mesh
    along = (np.arange(MARKERS) + 0.5) / MARKERS
    places = np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
    places = jnp.asarray(places * np.asarray(mesh.rest).max(axis=0), float)
    in_plane = (0, 0), (0, 1)  # z = 0
    faces, weights = nearest(jnp.pad(places, in_plane), jnp.pad(mesh.rest, in_plane), mesh.faces)
    markers = jnp.einsum("mk,tmki->tmi", weights, x[:, mesh.faces[faces]])
    return np.asarray(markers + noise * jr.normal(key, markers.shape, float))


def _clouds(x, scenario: Scenario, seen: Sensing, key) -> list[np.ndarray]:
    mesh = scenario.scene.mesh
    resolution = math.ceil(longest_edge(mesh) / SPACING - 1e-3)
    lowest = scenario.scene.table.height + seen.margin
    points, kept = _observe(x, mesh.faces, resolution, lowest, seen, jr.split(key, len(x)))
    points, kept = np.asarray(points), np.asarray(kept)
    return [cloud[visible] for cloud, visible in zip(points, kept, strict=True)]


@eqx.filter_jit
@partial(eqx.filter_vmap, in_axes=(0, None, None, None, None, 0))
def _observe(x: Float[Array, "vertex 3"], faces, resolution: int, lowest, seen: Sensing, key):
    """Noisy points of the surface, and which of them the cameras record."""
    key_pick, key_noise, key_where = jr.split(key, 3)
    surface = sample(x, faces, resolution)
    visible = surface[:, 2] > lowest
    if seen.cameras:
        by_camera = [camera.sees(surface) for camera in seen.cameras]
        visible &= jnp.any(jnp.stack(by_camera), axis=0)
    # a random order with the visible points in front, so that its first ones are drawn from them
    order = jnp.argsort(jr.uniform(key_pick, visible.shape, float) + (~visible).astype(float))
    count = min(seen.points, len(surface))
    order = order[:count]
    points = surface[order] + seen.noise * jr.normal(key_noise, (count, 3), float)
    if not seen.outliers:
        return points, visible[order]
    low, high = (jnp.asarray(end, float) for end in seen.region)
    where = jr.uniform(key_where, (count, 3), float)
    stray = low[None] + (high - low)[None] * where
    # three at least: of a sheet flat on the table no point is visible
    strays = jnp.maximum(3, seen.outliers * jnp.sum(visible[order], dtype=float))
    is_stray = jnp.arange(count, dtype=float) >= count - strays
    return jnp.where(is_stray[:, None], stray, points), visible[order] | is_stray
