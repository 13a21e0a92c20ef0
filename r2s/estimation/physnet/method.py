"""PhysNet as a method: a fabric from depth images, by a search on the physics similarity map.

The loss is the distance, frame by frame, between the points that a network gives the recorded and
the simulated images (Duan et al. 2022). Both pass the same preprocessing, and the simulation
follows the recorded gripper. The network is trained before, or now.

Of a stretching the force on the clamp is one more coordinate of a frame's point, which the papers
have not: a sheet that is stretched on a table stays flat, so that images hardly depend on it.

Needs scikit-optimize and scikit-learn: pip install 'r2s[physnet]'.
"""

import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.checks import expect
from r2s._util.extras import require
from r2s.estimation.checkpoint import fingerprint
from r2s.estimation.default_spaces import RANGES
from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.method import ANY, Budget, DataRequirements, Method, seed_of
from r2s.estimation.physnet import dataset, training
from r2s.estimation.physnet.images import View, depths_of_sheet, grey, of_clouds, per_face
from r2s.estimation.physnet.search import BATCH, Places, search
from r2s.estimation.problem import force_at, read_by_problem
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.recording import Recording
from r2s.scenarios.energy import clamp_force, energy_balance
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import Scenario, SheetSolver, at_frames, from_recording, rollout
from r2s.scenarios.standard import SCENARIOS

Images = Float[np.ndarray, "frame down across"]
# A flawed image lies 0.45 from a flawless one on the map, and a sheet of 9 x 9
# vertices errs by some 5 % in the force of a pull: both get the same weight.
FLAW, SHARE = 0.45, 0.05
SCALE = FLAW / SHARE
NOISE = 0.01  # [N] of a load cell, which is to count no more than a flaw either
NETWORK_SHAPE = {"cloth": (9, 9), "mpm": (7, 7)}


class PullForce(eqx.Module):
    """The recorded force on the pulled clamp at the frames of the images.

    - `values`: along the pull, [N]. - `direction`: of the pull, a unit vector.
    - `least`: less than this counts by its difference, more by its ratio, [N].
    """

    values: Float[Array, " frame"]
    direction: Float[Array, "3"]
    least: Float[Array, ""]

    @property
    def recorded(self) -> Float[Array, "frame 1"]:
        """The coordinate of what was recorded."""
        return self.coordinate(self.values)

    def coordinate(self, force: Float[Array, " frame"]) -> Float[Array, "frame 1"]:
        """The coordinate of a force [N] along the pull."""
        return SCALE * jnp.arcsinh(force / self.least)[:, None]


def pull_force(recording: Recording, frames: Sequence[int]) -> PullForce | None:
    """The force of a recording at some frames; None where it is no stretching, or has no force.

    What is across the pull is left out: it is noise for the most part. `least` is `SHARE` of the
    largest force, or what lets `NOISE` count like a flawed image. Raises as `force_at`, and
    `ValueError` where the force is zero.
    """
    if recording.info.scenario != "stretching":
        return None
    force = force_at(recording, list(frames))
    if force is None:
        return None
    direction = jnp.asarray(recording.info.sheet.warp, float)
    along = force.values @ (force.directions @ direction)
    largest = jnp.max(jnp.abs(along))
    is_pulled = bool(largest > 0)
    expect(is_pulled, f"{recording.info.name}: the force on the pulled clamp is zero throughout")
    return PullForce(along, direction, jnp.maximum(SHARE * largest, NOISE / SHARE))


class ImageObservation(eqx.Module):
    """A recorded motion on the map, and all that its simulation needs.

    - `scenario`: the motion.
    - `points`: points of the recorded images on the map.
    - `space`: the fabrics among which is searched.
    - `network`: the embedding.
    - `solver`: None for the cloth.
    - `frames`: frames of the scenario at which the images were recorded.
    - `view`, `per_face`: see `r2s.estimation.physnet.images.depths_of_sheet`.
    - `pull`: the force of a pull, whose coordinates `points` have, too; None: of images alone.
    """

    scenario: Scenario
    points: Float[Array, "frame dim"]
    space: ParameterSpace
    network: training.PhysNet
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
        trained: training.Training,
        solver: SheetSolver | None = None,
        pull: PullForce | None = None,
    ) -> "ImageObservation":
        """An observation from recorded images.

        - `images`: of `r2s.estimation.physnet.images`, one for each of the `frames`.
        - `trained`: the network with its view.
        - `pull`: the force at the same frames, see `pull_force`.
        """
        network, view = trained.network, trained.view
        points = _points(network, jnp.asarray(images, float))
        if pull is not None:
            points = jnp.concatenate([points, pull.recorded], axis=1)
        rest = np.asarray(scenario.scene.mesh.rest)
        warp, weft = (len(np.unique(rest[:, axis].round(6))) for axis in (0, 1))
        width, height = (float(side) for side in np.ptp(rest, axis=0))
        fine = per_face(view, (warp, weft), (width, height))
        return cls(scenario, points, space, network, solver, frames, view, fine, pull)

    @property
    def target(self) -> Float[np.ndarray, " part"]:
        """The answer that a search is to reach: that of the recorded images."""
        return np.asarray(_flat(self.points))


@eqx.filter_jit
def _points(network: training.PhysNet, images: Float[Array, "frame down across"]) -> Array:
    return jax.vmap(network)(images)


@eqx.filter_jit
def answers(
    observation: ImageObservation, places: Float[Array, "place dim"]
) -> Float[Array, "place part"]:
    """The points on the map of the simulated frames of each fabric, as one vector (see `_flat`).

    It is NaN where the simulation diverges.
    """
    scenario, frames = observation.scenario, jnp.array(observation.frames)

    def of_place(place):
        fabric, force = observation.space(place), []
        if (pull := observation.pull) is None:
            motion = rollout(scenario, fabric, solver=observation.solver)
            x, ok = motion.x, jnp.all(motion.ok)
        else:
            motion = energy_balance(scenario, fabric, solver=observation.solver)
            ok = jnp.all(jnp.isfinite(motion.x)) & jnp.all(jnp.isfinite(motion.last))
            x, _ = at_frames(scenario, motion.x, motion.v)
            force = [pull.coordinate(clamp_force(scenario, motion)[frames] @ pull.direction)]
        x, faces = x[frames], scenario.scene.mesh.faces
        depth = depths_of_sheet(observation.view, x, faces, observation.per_face)
        images = jax.vmap(partial(grey, observation.view))(depth)
        points = jnp.concatenate([jax.vmap(observation.network)(images), *force], axis=1)
        return jnp.where(ok & jnp.all(jnp.isfinite(x)), _flat(points), jnp.nan)

    return jax.vmap(of_place)(places)


def _flat(points: Float[Array, "frame dim"]) -> Float[Array, " part"]:
    """Points as one vector, scaled so that the root mean square difference of two such vectors is
    that of the frames' distances."""
    return points.reshape(-1) * jnp.sqrt(jnp.asarray(points.shape[-1], points.dtype))


def estimate(
    observation: ImageObservation,
    *,
    published: bool = False,
    num_calls: int = 80,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Estimate:
    """The fabric most likely to look as recorded, by `num_calls` simulations.

    - `published`: by Bayesian optimisation of the distance on the map, as in the study of Duan et
      al.; the estimate is the best simulation. Otherwise an emulator predicts the points of
      simulated images, and the last simulation is that of the estimate.
    - `path`: file of the search, from which it continues; one of another observation is refused.
    - `progress`: called with the number of simulations and the least loss, after every batch.

    Losses are distances on the map, without unit. There are no standard errors: repeat with other
    seeds. Raises `RuntimeError` when all simulations diverge, or the last one.
    """
    began, space = time.perf_counter(), observation.space

    def respond(places: Places) -> Float[np.ndarray, "place part"]:
        padded = np.full((BATCH, places.shape[1]), 0.5)  # so that it compiles once
        padded[: len(places)] = places
        return np.asarray(answers(observation, jnp.asarray(padded, float)))[: len(places)]

    trials = search(
        respond,
        observation.target,
        space.dim,
        published=published,
        num_calls=num_calls,
        shared=len(observation.frames),  # the error of the images is the same in all frames
        seed=seed,
        path=path,
        run=fingerprint(observation) if path else "",
        progress=progress,
    )
    losses, places = trials.losses, jnp.asarray(trials.places, float)
    chosen = int(np.nanargmin(losses)) if published else len(losses) - 1
    if not np.isfinite(losses[chosen]):
        raise RuntimeError("the simulation of the estimate diverged: narrow the ranges")
    way = "Bayesian optimisation" if published else "emulated answers"
    return point_estimate(
        f"physnet ({way}, {num_calls} simulations)",
        space,
        places[chosen],
        float(losses[chosen]),
        losses[:, None],
        np.asarray(jax.vmap(space.values)(places))[:, None],
        time.perf_counter() - began,
        loss_unit="-",
    )


@dataclass(frozen=True)
class TrainingBudget:
    """What the training of a network may cost: simulated fabrics, epochs, steps of each."""

    fabrics: int = 512
    epochs: int = 9
    steps: int = 80


def train_network(
    path: Path,
    scenario: str,
    solver: str,
    budget: TrainingBudget = TrainingBudget(),
    seed: int = 0,
    progress: bool = False,
) -> training.Training:
    """Train the network for a scenario on a solver, and write it to `path`.

    The simulated images lie in a folder beside `path` until it is trained, so that a killed run
    continues. `progress` shows a bar of the simulations, and prints a line an epoch, on stderr.
    Raises `ValueError` for a scenario that r2s does not simulate.
    """
    expect(scenario in SCENARIOS, f"scenario must be one of {list(SCENARIOS)}, found {scenario!r}")
    options: dict[str, Any] = {"ranges": RANGES}
    if solver == "mpm":
        shape = NETWORK_SHAPE[solver]
        options = {"solver": solver, "num_levels": 3, "shape": shape, "per_shard": 4}
    settings = dataset.Settings(scenario, budget.fabrics, seed=seed, **options)
    folder = path.with_name(f"{path.name}.images")
    view = dataset.make(folder, settings, progress=progress).view
    schedule = training.Schedule(epochs=budget.epochs, steps=budget.steps, seed=seed)
    if path.exists():
        begun = training.load(path)
    else:
        begun = training.begin(view, schedule=schedule)._replace(data=f"{scenario} on {solver}")

    def report(epoch: int, row: training.Row) -> None:
        print(f"network, epoch {epoch}: triplet accuracy {row.accuracy:.1%}", file=sys.stderr)

    trained = training.train(begun, dataset.load(folder), path, report if progress else None)
    shutil.rmtree(folder)
    return trained


def _images_of(recording: Recording) -> tuple[int, ...]:
    """The frames of which the network has images."""
    return dataset.frame_indices(recording.info.frames_used, dataset.Settings.num_frames)


@dataclass(frozen=True, kw_only=True)
class PhysNetMethod(Method):
    """PhysNet: by `Budget.evaluations` simulations, whose places on the map are emulated.

    - `network`: the file of a network that was trained for the recording's scenario on the same
      solver. Where there is no such file one is trained, and written there.
    - `training_budget`: what that training may cost.
    """

    name = "physnet"
    budget = Budget(max_evaluations=80)
    budget_fields = ("max_evaluations",)
    supports = {"cloth": ANY, "mpm": ANY}
    takes_shape = False
    library: ClassVar[str] = "sklearn"
    published: ClassVar[bool] = False  # without the force of a stretching, too

    network: Path | None = None
    training_budget: TrainingBudget = TrainingBudget()

    def reads(self, recording):
        force = not self.published and read_by_problem(recording).force
        return DataRequirements(_images_of(recording), points=None, force=force)

    def _estimate(self, recordings, space, budget, key):
        require(self.library, "physnet", self.name)  # before hours of training
        recording, solver = recordings[0], self.chosen_solver
        trained = self._trained(recording, seed_of(key))
        scenario = from_recording(recording, NETWORK_SHAPE[solver])
        frames = _images_of(recording)
        recorded = of_clouds(trained.view, recording, frames)
        stiffest = space(jnp.ones(space.dim, float))
        points = None if solver == "cloth" else mpm_cloth(scenario, stiffest)
        pull = None if self.published else pull_force(recording, frames)
        observation = ImageObservation.make(
            scenario, recorded, frames, space, trained, points, pull
        )
        return estimate(
            observation,
            published=self.published,
            num_calls=budget.max_evaluations,
            seed=seed_of(key),
            path=self.checkpoint,
            progress=self.progress,
        )

    def _trained(self, recording: Recording, seed: int) -> training.Training:
        if self.network is None:
            raise ValueError("PhysNet needs a file for its trained network")
        if self.network.exists():
            trained = training.load(self.network)
            needed = f"{recording.info.scenario} on {self.chosen_solver}"
            if trained.data not in ("", needed):
                raise ValueError(
                    f"{self.network}: the network was trained for {trained.data}, the recording "
                    f"needs one for {needed}: name another file"
                )
            if len(trained.curve) >= trained.schedule.epochs:
                return trained
        return train_network(
            self.network,
            recording.info.scenario,
            self.chosen_solver,
            self.training_budget,
            seed=seed,
            progress=self.progress is not None,
        )


@dataclass(frozen=True, kw_only=True)
class PublishedPhysNet(PhysNetMethod):
    """PhysNet as published: Bayesian optimisation of the distance on the map."""

    name = "physnet-published"
    library: ClassVar[str] = "skopt"
    published: ClassVar[bool] = True
