"""PhysNet: a fabric from depth images, by Bayesian optimisation on the physics similarity map.

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

from r2s.estimators import bayes
from r2s.estimators.bayes import History, Objective
from r2s.estimators.estimate import Estimate, without_deviations
from r2s.family import Family
from r2s.observe.calibration import DepthCamera, frustum
from r2s.physnet.network import PhysNet
from r2s.physnet.preprocess import grey
from r2s.physnet.training import Training
from r2s.physnet.views import View, depths_of_sheet, per_face
from r2s.scenario import Scenario, motion
from r2s.solver import Solver

REFINE = 0.45  # of the simulations
STEP = 0.04  # of a range, of differences
LENGTHS = (1.0, 0.5, 0.25, 0.1)  # of a Gauss-Newton step
LEAST_GAIN = 1e-3  # of the loss, or no further step is made
RANGE_VARIANCE = 1 / 12  # of a place drawn evenly from a range

Images = Float[np.ndarray, "frame down across"]


class Sighting(eqx.Module):
    """A recorded motion on the map, and how to simulate it.

    - `scenario`, `frames`: which of its frames were seen. - `points`: where those images lie.
    - `family`: the fabrics to choose from. - `solver`: None for the cloth.
    - `cameras`: what is in the frame of each, of `frustum`; None: all of the sheet is.
    """

    scenario: Scenario
    points: Float[Array, "frame dim"]
    family: Family
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
        family: Family,
        training: Training,
        solver: Solver | None = None,
        cameras: Sequence[DepthCamera] = (),
    ) -> "Sighting":
        """From images of `r2s.physnet.preprocess` at some frames of a scenario.

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
        return cls(scenario, points, family, training.network, solver, *about, planes)


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
        fabric = sighting.family(place)
        found = motion(sighting.scenario, fabric, solver=sighting.solver)
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
    """The loss of places as `r2s.estimators.bayes` asks for them, simulated `batch` together."""
    respond, target = responses(sighting, batch), np.asarray(_flat(sighting.points))
    return lambda places: np.sqrt(((respond(places) - target) ** 2).mean(axis=1))


def refined(
    sighting: Sighting, history: History, num_calls: int, batch: int = 4, dim_step: float = STEP
) -> History:
    """The history with Gauss-Newton steps from its best place, of at most `num_calls` simulations.

    The residuals are how far each frame's image lies on the map from the recorded one, along its
    axes; their slopes are differences over `dim_step` of a range; the ranges count as a prior, by
    what is left of the residuals. Each step tries shorter ones, too, and takes the best.
    """
    respond, target = responses(sighting, batch), np.asarray(_flat(sighting.points))
    dim = history.places.shape[1]

    def tried(places: np.ndarray) -> np.ndarray:
        nonlocal history
        starts = range(0, len(places), batch)
        residuals = np.concatenate([respond(places[i : i + batch]) for i in starts]) - target
        history = bayes.tell(history, places, np.sqrt((residuals**2).mean(axis=1)))
        return residuals

    while num_calls >= dim + 1 + len(LENGTHS):
        place, least = history.places[history.best], np.nanmin(history.losses)
        sides = np.where(place > 0.5, -dim_step, dim_step)
        residuals = tried(np.concatenate([place[None], place + np.diag(sides)]))
        slopes = np.nan_to_num((residuals[1:] - residuals[0]).T / sides)
        # the error of the images counts as the same in all frames
        noise = len(sighting.frames) * (residuals[0] ** 2).mean()
        step = _gauss_newton(slopes, residuals[0], place, noise)
        tried(np.clip(place + np.array(LENGTHS)[:, None] * step, 0, 1))
        num_calls -= dim + 1 + len(LENGTHS)
        if np.nanmin(history.losses) > (1 - LEAST_GAIN) * least:
            break
    return history


def _gauss_newton(
    slopes: np.ndarray, residuals: np.ndarray, place: np.ndarray, noise: float
) -> np.ndarray:
    """The step to the least sum of squares, with the range as prior, by the variance `noise`."""
    weight = noise / RANGE_VARIANCE
    matrix = slopes.T @ slopes + weight * np.eye(len(place))
    return np.linalg.solve(matrix, -slopes.T @ residuals - weight * (place - 0.5))


def estimate(
    sighting: Sighting,
    *,
    num_calls: int = 80,
    refine: float = REFINE,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[History], None] | None = None,
) -> Estimate:
    """The fabric of the least distance on the map among `num_calls` simulations.

    As many Gauss-Newton steps as fit a share `refine` of them are made from where Bayesian
    optimisation ended, as of `refined`; none, as in the study, for 0. Goes on from the history of
    the optimisation in `path`. The losses are distances on the map, without unit. Gives no
    deviations: repeat with other seeds. Raises `RuntimeError` when all simulations diverge.
    """
    began = time.perf_counter()
    family = sighting.family
    each = family.dim + 1 + len(LENGTHS)  # simulations of a Gauss-Newton step
    searched = num_calls - each * int(refine * num_calls / each)
    about = {"num_calls": searched, "batch": batch, "seed": seed}
    history = bayes.minimise(
        objective(sighting, batch), family.dim, **about, path=path, progress=progress
    )
    history = refined(sighting, history, num_calls - searched, batch)
    place = jnp.asarray(history.places[history.best], float)
    values = np.asarray(jax.vmap(family.values)(jnp.asarray(history.places, float)))
    return without_deviations(
        f"physnet (Bayesian optimisation, {searched} simulations; {len(history.losses) - searched} "
        "of Gauss-Newton)",
        family,
        place,
        float(history.losses[history.best]),
        history.losses[:, None],
        values[:, None],
        time.perf_counter() - began,
    )
