"""PhysNet: a fabric from depth images, by a search on the physics similarity map.

After Duan et al. 2022. The loss is the distance, frame by frame, between the points that a trained
network gives the recorded and the simulated images. Both pass the same preprocessing, and the
simulation follows the recorded gripper. Of a stretching the force on the clamp counts, too
(`r2s.estimation.physnet.pull_force`), which the papers have not.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation.checkpoint import fingerprint
from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.physnet import bayes, emulator, search
from r2s.estimation.physnet.network import PhysNet
from r2s.estimation.physnet.preprocess import grey
from r2s.estimation.physnet.pull_force import PullForce, moved_with_forces
from r2s.estimation.physnet.training import Training
from r2s.estimation.physnet.views import View, depths_of_sheet, per_face
from r2s.materials.parameters import ParameterSpace
from r2s.scenarios.scenario import Scenario, SheetSolver, rollout

Images = Float[np.ndarray, "frame down across"]


class Sighting(eqx.Module):
    """A recorded motion on the map, and all that its simulation needs.

    - `scenario`: the motion.
    - `points`: points of the recorded images on the map.
    - `space`: the fabrics among which is searched.
    - `network`: the embedding.
    - `solver`: None for the cloth.
    - `frames`: frames of the scenario at which the images were recorded.
    - `view`, `per_face`: see `views.depths_of_sheet`.
    - `pull`: the force of a pull, whose coordinates `points` have, too; None: of images alone.
    """

    scenario: Scenario
    points: Float[Array, "frame dim"]
    space: ParameterSpace
    network: PhysNet
    solver: SheetSolver | None
    frames: tuple[int, ...] = eqx.field(static=True)
    view: View = eqx.field(static=True)
    per_face: int = eqx.field(static=True)
    pull: PullForce | None = None

    @classmethod
    def make(
        cls,
        scenario: Scenario,
        images: Images,
        frames: tuple[int, ...],
        space: ParameterSpace,
        training: Training,
        solver: SheetSolver | None = None,
        pull: PullForce | None = None,
    ) -> "Sighting":
        """A sighting from recorded images.

        - `images`: of `r2s.estimation.physnet.preprocess`, one for each of the `frames`.
        - `training`: the trained network with its view.
        - `pull`: the force at the same frames, see `r2s.estimation.physnet.pull_force`.

        Raises `ValueError` when images and frames differ in number, or a frame is not simulated.
        """
        if len(images) != len(frames) or not all(0 <= f < scenario.num_frames for f in frames):
            raise ValueError(
                f"{len(images)} images at frames {frames}, of {scenario.num_frames} simulated: "
                "expected one image for each frame"
            )
        points = eqx.filter_jit(jax.vmap(training.network))(jnp.asarray(images, float))
        if pull is not None:
            points = jnp.concatenate([points, pull.recorded], axis=1)
        rest = np.asarray(scenario.scene.mesh.rest)
        along = tuple(len(np.unique(rest[:, axis].round(6))) for axis in (0, 1))
        width, height = (float(side) for side in np.ptp(rest, axis=0))
        fine = per_face(training.view, (along[0], along[1]), (width, height))
        return cls(
            scenario=scenario,
            points=points,
            space=space,
            network=training.network,
            solver=solver,
            frames=frames,
            view=training.view,
            per_face=fine,
            pull=pull,
        )


@eqx.filter_jit
def answers(sighting: Sighting, places: Float[Array, "place dim"]) -> Float[Array, "place part"]:
    """The points on the map of the simulated frames of each fabric, as one vector (see `_flat`).

    It is NaN where the simulation diverges.
    """

    def of_place(place):
        fabric = sighting.space(place)
        if sighting.pull is None:
            found = rollout(sighting.scenario, fabric, solver=sighting.solver)
            ok = jnp.all(found.ok)
        else:
            found, ok = moved_with_forces(sighting.scenario, fabric, sighting.solver)
        x = found.x[jnp.array(sighting.frames)]
        faces = sighting.scenario.scene.mesh.faces
        depth = depths_of_sheet(sighting.view, x, faces, sighting.per_face)
        images = jax.vmap(partial(grey, sighting.view))(depth)
        points = jax.vmap(sighting.network)(images)
        if sighting.pull is not None:
            force = sighting.pull.simulated(sighting.scenario, found, sighting.frames)
            points = jnp.concatenate([points, force], axis=1)
        whole = ok & jnp.all(jnp.isfinite(x))
        return jnp.where(whole, _flat(points), jnp.nan)

    return jax.vmap(of_place)(places)


def _flat(points: Float[Array, "frame dim"]) -> Float[Array, " part"]:
    """Points as one vector, scaled so that the root mean square difference of two such vectors is
    that of the frames' distances."""
    return points.reshape(-1) * jnp.sqrt(jnp.asarray(points.shape[-1], points.dtype))


def target_of(sighting: Sighting) -> Float[np.ndarray, " part"]:
    """The answer that a search is to reach: that of the recorded images."""
    return np.asarray(_flat(sighting.points))


def responses(sighting: Sighting, batch: int) -> search.Respond:
    """The function from up to `batch` places to their answers, simulated together."""

    def respond(places: search.Places) -> Float[np.ndarray, "place part"]:
        padded = np.full((batch, places.shape[1]), 0.5)  # so that it compiles once
        padded[: len(places)] = places
        return np.asarray(answers(sighting, jnp.asarray(padded, float)))[: len(places)]

    return respond


def objective(
    sighting: Sighting, batch: int
) -> Callable[[search.Places], Float[np.ndarray, " place"]]:
    """The function from up to `batch` places to the rms distances of their frames on the map.

    A distance is NaN where the simulation diverges.
    """
    respond, recorded = responses(sighting, batch), target_of(sighting)
    return lambda places: np.sqrt(((respond(places) - recorded) ** 2).mean(axis=1))


def estimate(
    sighting: Sighting,
    *,
    num_calls: int = 80,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Estimate:
    """The fabric most likely to look as recorded, by `num_calls` simulations.

    - `batch`: simulations that run together.
    - `path`: file of the search, from which it continues; one of another sighting is refused.
    - `progress`: called with the number of simulations and the least loss, after every batch.

    An emulator (`r2s.estimation.physnet.emulator`) predicts the points of simulated images; the
    last simulation is that of the estimate. Losses are distances on the map, without unit. There
    are no standard errors: repeat with other seeds. Raises `RuntimeError` when all simulations
    diverge, or the last one.
    """
    # the error of the images counts as the same in all frames
    how = partial(emulator.search, num_calls=num_calls, shared=len(sighting.frames))
    name = f"physnet (emulated answers, {num_calls} simulations)"
    return _searched(sighting, name, how, False, batch, seed, path, progress)


def published_recipe(
    sighting: Sighting,
    *,
    num_calls: int = 80,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Estimate:
    """The fabric of the least distance on the map among `num_calls` simulations.

    Bayesian optimisation of that distance (`r2s.estimation.physnet.bayes`) chooses them, as in the
    study of Duan et al. The arguments are those of `estimate`.
    """
    how = partial(search.minimise, ask=bayes.ask, num_calls=num_calls)
    name = f"physnet (Bayesian optimisation, {num_calls} simulations)"
    return _searched(sighting, name, how, True, batch, seed, path, progress)


def _searched(
    sighting: Sighting,
    name: str,
    how: Callable[..., search.Trials],
    takes_best: bool,
    batch: int,
    seed: int,
    path: Path | str | None,
    progress: Callable[[int, float], None] | None,
) -> Estimate:
    """The estimate by a search: of its best trial, or of its last one."""
    began, space = time.perf_counter(), sighting.space
    trials = how(
        responses(sighting, batch),
        target_of(sighting),
        dim=space.dim,
        batch=batch,
        seed=seed,
        path=path,
        run=fingerprint(sighting) if path else "",
        progress=progress,
    )
    losses, places = trials.losses, jnp.asarray(trials.places, float)
    chosen = int(np.nanargmin(losses)) if takes_best else len(losses) - 1
    if not np.isfinite(losses[chosen]):
        moved = eqx.filter_jit(rollout)(
            sighting.scenario, space(places[chosen]), solver=sighting.solver
        )
        raise RuntimeError(f"the simulation of the estimate {moved.explain()} Narrow the ranges.")
    return point_estimate(
        name,
        space,
        places[chosen],
        float(losses[chosen]),
        losses[:, None],
        np.asarray(jax.vmap(space.values)(places))[:, None],
        time.perf_counter() - began,
        loss_unit="-",
    )
