"""PhysNet by the contract of `r2s.estimation.method`: with a trained network, or one trained now.

Needs scikit-optimize and scikit-learn: pip install 'r2s[physnet]'.
"""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp

from r2s._util.extras import require
from r2s.estimation.default_spaces import RANGES
from r2s.estimation.method import ANY, Budget, DataRequirements, Method, seed_of
from r2s.estimation.physnet import dataset, estimator, images, training
from r2s.estimation.problem import read_by_problem
from r2s.recordings.recording import Recording
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import from_recording

NETWORK_SHAPE = {"cloth": (9, 9), "mpm": (7, 7)}


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
    """
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
        recorded = images.of_clouds(trained.view, recording, frames)
        stiffest = space(jnp.ones(space.dim, float))
        points = None if solver == "cloth" else mpm_cloth(scenario, stiffest)
        pull = None if self.published else estimator.pull_force(recording, frames)
        observation = estimator.ImageObservation.make(
            scenario, recorded, frames, space, trained, points, pull
        )
        return estimator.estimate(
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
