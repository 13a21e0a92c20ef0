"""PhysNet: a fabric from depth images, by a search on the physics similarity map.

After Duan et al. 2022. The loss is the distance, frame by frame, between where a trained network
puts the recorded and the simulated images. Both pass the same preprocessing, and the simulation
follows the recorded gripper.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.physnet import bayes, emulator
from r2s.estimation.physnet.bayes import History, Objective
from r2s.estimation.physnet.network import PhysNet
from r2s.estimation.physnet.preprocess import grey
from r2s.estimation.physnet.training import Training
from r2s.estimation.physnet.views import View, depths_of_sheet, per_face
from r2s.fabrics.parameters import ParameterSpace
from r2s.recordings.cameras.calibration import DepthCamera, frustum
from r2s.scenarios.scenario import Scenario, rollout
from r2s.solver import Solver

Images = Float[np.ndarray, "frame down across"]


class Sighting(eqx.Module):
    """A recorded motion on the map, and how to simulate it.

    - `scenario`, `frames`: which of its frames were seen. - `points`: where those images lie.
    - `family`: the fabrics to choose from. - `solver`: None for the cloth.
    - `cameras`: what is in the frame of each, of `frustum`; None: all of the sheet is.
    """

    scenario: Scenario
    points: Float[Array, "frame dim"]
    space: ParameterSpace
    network: PhysNet
    solver: Solver | None
    frames: tuple[int, ...] = eqx.field(static=True)
    view: View = eqx.field(static=True)
    per_face: int = eqx.field(static=True)
    cameras: Float[Array, "camera 4 4"] | None = None

    @classmethod
    def make(
        cls,
        scenario: Scenario,
        images: Images,
        frames: tuple[int, ...],
        space: ParameterSpace,
        training: Training,
        solver: Solver | None = None,
        cameras: Sequence[DepthCamera] = (),
    ) -> "Sighting":
        """From images of `r2s.estimation.physnet.preprocess` at some frames of a scenario.

        Where `cameras` are given, simulated images too lack what all of them have out of frame.
        Raises `ValueError` when images and frames differ in number, or a frame is not simulated.
        """
        if len(images) != len(frames) or not all(0 <= f < scenario.num_frames for f in frames):
            raise ValueError(
                f"{len(images)} images at frames {frames}, of {scenario.num_frames} simulated: "
                "expected one image for each frame"
            )
        points = embedded(training.network, jnp.asarray(images, float))
        rest = np.asarray(scenario.scene.mesh.rest)
        along = tuple(len(np.unique(rest[:, axis].round(6))) for axis in (0, 1))
        width, height = (float(side) for side in np.ptp(rest, axis=0))
        fine = per_face(training.view, (along[0], along[1]), (width, height))
        about = frames, training.view, fine
        planes = [frustum(camera) for camera in cameras]
        planes = jnp.asarray(np.stack(planes), float) if planes else None
        return cls(scenario, points, space, training.network, solver, *about, planes)


@eqx.filter_jit
def embedded(
    network: PhysNet, images: Float[Array, "image down across"]
) -> Float[Array, "image dim"]:
    """Where images lie on the map."""
    return jax.vmap(network)(images)


@eqx.filter_jit
def answers(sighting: Sighting, places: Float[Array, "place dim"]) -> Float[Array, "place part"]:
    """Where the simulated frames of each fabric lie on the map, one after the other.

    In units in which the root mean square of the parts' differences is that of the frames'
    distances. NaN where the simulation diverges.
    """

    def of_place(place):
        fabric = sighting.space(place)
        found = rollout(sighting.scenario, fabric, solver=sighting.solver)
        x = found.x[jnp.array(sighting.frames)]
        faces = sighting.scenario.scene.mesh.faces
        about = sighting.per_face, sighting.cameras
        depth = depths_of_sheet(sighting.view, x, faces, *about)
        images = jax.vmap(lambda image: grey(sighting.view, image))(depth)
        points = jax.vmap(sighting.network)(images)
        whole = jnp.all(found.ok) & jnp.all(jnp.isfinite(x))
        return jnp.where(whole, _flat(points), jnp.nan)

    return jax.vmap(of_place)(places)


def _flat(points: Float[Array, "frame dim"]) -> Float[Array, " part"]:
    return points.reshape(-1) * jnp.sqrt(jnp.asarray(points.shape[-1], points.dtype))


def target_of(sighting: Sighting) -> Float[np.ndarray, " part"]:
    """Where the recorded frames lie on the map, in the units of `answers`."""
    return np.asarray(_flat(sighting.points))


def distances(sighting: Sighting, places: Float[Array, "place dim"]) -> Float[Array, " place"]:
    """The rms distance [-] on the map between the recorded frames and those of each fabric.

    NaN where the simulation diverges.
    """
    squares = (answers(sighting, places) - _flat(sighting.points)[None]) ** 2
    return jnp.sqrt(jnp.mean(squares, axis=1))


def responses(
    sighting: Sighting, batch: int
) -> Callable[[Float[np.ndarray, "place dim"]], Float[np.ndarray, "place part"]]:
    """The answers of any number of places up to `batch`, simulated together."""

    def respond(places):
        padded = np.full((batch, places.shape[1]), 0.5)  # so that it compiles once
        padded[: len(places)] = places
        return np.asarray(answers(sighting, jnp.asarray(padded, float)))[: len(places)]

    return respond


def objective(sighting: Sighting, batch: int) -> Objective:
    """The loss of places, simulated `batch` together, for `r2s.estimation.physnet.bayes`."""
    respond, target = responses(sighting, batch), target_of(sighting)
    return lambda places: np.sqrt(((respond(places) - target) ** 2).mean(axis=1))


def estimate(
    sighting: Sighting,
    *,
    num_calls: int = 80,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[emulator.Trials], None] | None = None,
) -> Estimate:
    """The fabric most likely to look as recorded, by `num_calls` simulations.

    Where its images lie on the map is emulated, as of `r2s.estimation.physnet.emulator`; the last
    simulation is of the estimate. Goes on from `path`. The losses are distances on the map, without
    unit. Gives no deviations: repeat with other seeds. Raises `RuntimeError` when all simulations
    diverge, or the last one.
    """
    began = time.perf_counter()
    target = target_of(sighting)
    about = {"num_calls": num_calls, "batch": batch, "seed": seed, "path": path}
    frames = len(sighting.frames)  # the error of the images counts as the same in all of them
    dim = sighting.space.dim
    trials = emulator.minimise(
        responses(sighting, batch), target, dim, shared=frames, progress=progress, **about
    )
    losses = trials.losses(target)
    if not np.isfinite(losses[-1]):
        raise RuntimeError("the simulation of the estimate diverged: narrow the ranges")
    name = f"physnet (emulated answers, {num_calls} simulations)"
    return _told(sighting, name, trials.places, losses, -1, began)


def original(
    sighting: Sighting,
    *,
    num_calls: int = 80,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[History], None] | None = None,
) -> Estimate:
    """The fabric of the least distance on the map among `num_calls` simulations, by Bayesian
    optimisation of that distance, as in the study; otherwise as `estimate`."""
    began = time.perf_counter()
    about = {"num_calls": num_calls, "batch": batch, "seed": seed, "path": path}
    lossy, dim = objective(sighting, batch), sighting.space.dim
    history = bayes.minimise(lossy, dim, progress=progress, **about)
    name = f"physnet (Bayesian optimisation, {num_calls} simulations)"
    return _told(sighting, name, history.places, history.losses, history.best, began)


def _told(sighting: Sighting, name: str, places, losses, best: int, began: float) -> Estimate:
    space = sighting.space
    values = np.asarray(jax.vmap(space.values)(jnp.asarray(places, float)))
    return point_estimate(
        name,
        space,
        jnp.asarray(places[best], float),
        float(losses[best]),
        losses[:, None],
        values[:, None],
        time.perf_counter() - began,
    )
