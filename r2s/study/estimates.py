"""Cells that estimate: each approach from each scenario, on either solver."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from r2s.estimation import diffcloud, diffcp
from r2s.estimation.descent import DEFAULT
from r2s.estimation.estimate import Estimate, as_json, from_json
from r2s.estimation.physnet import dataset, estimator, preprocess, training
from r2s.estimation.problem import Problem
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import IsotropicSpace, OrthotropicSpace, ParameterSpace
from r2s.files import write_json
from r2s.recordings.recording import Recording
from r2s.scenarios.on_points import material_points
from r2s.scenarios.scenario import from_recording
from r2s.study.cells import Cell, result_files
from r2s.study.sources import Source, read

ESTIMATE, NETWORK = "estimate.json", "network.eqx"
COARSE = (7, 7)  # vertices of a sheet of material points in an estimate


@dataclass(frozen=True)
class Budgets:
    """What estimates may cost.

    - `coarse`, `starts`, `iterations`: of DIFFCLOUD, as of `r2s.estimation.descent.Effort`.
    - `points_coarse`, `points_starts`, `points_iterations`: likewise of DiffCP.
    - `calls`: simulations of PhysNet's search. - `fabrics`, `epochs`, `steps`: of its training.
    """

    coarse: int = 24
    starts: int = 3
    iterations: int = 25
    points_coarse: int = 12
    points_starts: int = 2
    points_iterations: int = 25
    calls: int = 80
    fabrics: int = 512
    epochs: int = 9
    steps: int = 80


@dataclass(frozen=True)
class TrainedNetwork(Cell):
    """PhysNet's network for a scenario on a solver."""

    kind: ClassVar[str] = "networks"
    weight: ClassVar[float] = 150.0

    solver: str
    scenario: str
    spent: Budgets = Budgets()
    seed: int = 0

    @property
    def name(self) -> str:
        return f"physnet_{self.solver}_{self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """A trained network; the simulated images are not kept."""
        settings = dataset.Settings(self.scenario, self.spent.fabrics, seed=self.seed)
        if self.solver == "points":
            settings = dataset.Settings(
                self.scenario,
                self.spent.fabrics,
                num_levels=3,
                shape=COARSE,
                per_shard=4,
                material_points=True,
                isotropic=True,
                seed=self.seed,
            )
        view = dataset.make(out / "data", settings, progress=False).view
        schedule = training.Schedule(
            epochs=self.spent.epochs, steps=self.spent.steps, seed=self.seed
        )
        trained = training.train(
            training.begin(view, schedule=schedule), dataset.load(out / "data"), out / NETWORK
        )
        shutil.rmtree(out / "data")
        return {"seed": self.seed, "triplet_accuracy": trained.curve[-1].accuracy}


@dataclass(frozen=True)
class EstimateCell(Cell):
    """An estimate of a fabric.

    - `approach`: "diffcloud", "diffcp", "physnet" or "pinn". - `solver`: "cloth" or "points".
    - `sources`: the recordings, of one scenario; several for the pulls of "pinn" alone.
    - `density`: areal, as weighed [kg/m^2]. - `network`: of "physnet".
    """

    kind: ClassVar[str] = "estimates"
    weight: ClassVar[float] = 40.0

    approach: str
    solver: str
    fabric: str
    sources: tuple[Source, ...]
    density: float
    spent: Budgets = Budgets()
    network: TrainedNetwork | None = None
    repeat: int = 0

    def __post_init__(self) -> None:
        scenarios = {source.scenario for source in self.sources}
        if len(scenarios) != 1:
            raise ValueError(f"an estimate is from one scenario, got {sorted(scenarios)}")
        if self.solver not in SOLVERS[self.approach]:
            raise ValueError(f"{self.approach} is not on {self.solver}: {SOLVERS[self.approach]}")

    @property
    def scenario(self) -> str:
        """What it is estimated from."""
        return self.sources[0].scenario

    @property
    def name(self) -> str:
        return f"{self.approach}_{self.solver}_{self.scenario}_{self.fabric}_{self.repeat}"

    @property
    def alike(self) -> str:
        return f"estimates {self.approach} {self.solver} {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """An estimate; one whose every simulation diverged is a result too, and says so."""
        recordings = [read(source, folder) for source in self.sources]
        space = family_of(self.solver, self.density)
        try:
            found = _ESTIMATORS[self.approach](self, space, recordings, folder)
        except jax.errors.JaxRuntimeError:  # out of memory, say: no result, to be tried again
            raise
        except (RuntimeError, FloatingPointError) as error:
            return {"seed": self.repeat, "diverged": f"{error}"}
        write_json(out / ESTIMATE, as_json(found))
        return {"seed": self.repeat, "diverged": ""}


SOLVERS = {
    "diffcloud": ("cloth",),
    "diffcp": ("points",),
    "physnet": ("cloth", "points"),
    "pinn": ("cloth", "points"),
}


def family_of(solver: str, density: float) -> ParameterSpace:
    """Among which fabrics is estimated: orthotropic on the cloth, isotropic on material points."""
    make = OrthotropicSpace.make if solver == "cloth" else IsotropicSpace.make
    return make(density)


def read_estimate(cell: EstimateCell, folder: Path) -> Estimate | None:
    """The estimate of a cell that is made; None where it diverged."""
    with result_files(cell, folder) as files:
        if not (files / ESTIMATE).exists():
            return None
        return from_json(json.loads((files / ESTIMATE).read_text(encoding="utf-8")))


def default_fabric(solver: str, density: float) -> Fabric:
    """What a study compares with: the middle of the space."""
    space = family_of(solver, density)
    return space(jnp.full(space.dim, 0.5, float))


def _diffcloud(cell: EstimateCell, space, recordings: list[Recording], folder: Path) -> Estimate:
    del folder
    spent = cell.spent
    budget = DEFAULT._replace(coarse=spent.coarse, starts=spent.starts, iterations=spent.iterations)
    problem = Problem.make(recordings[0], space)
    return diffcloud.estimate(problem, budget, key=jr.key(cell.repeat))


def _diffcp(cell: EstimateCell, space, recordings: list[Recording], folder: Path) -> Estimate:
    del folder
    spent = cell.spent
    about = {
        "coarse": spent.points_coarse,
        "starts": spent.points_starts,
        "iterations": spent.points_iterations,
    }
    budget = diffcp.DEFAULT._replace(**about)
    problem = Problem.make(recordings[0], space, shape=COARSE, as_seen=False)
    return diffcp.estimate(diffcp.on_points(problem), budget, key=jr.key(cell.repeat))


def _physnet(cell: EstimateCell, space: ParameterSpace, recordings: list[Recording], folder: Path):
    if cell.network is None:
        raise ValueError("PhysNet needs a trained network")
    with result_files(cell.network, folder) as files:
        trained = training.load(files / NETWORK)
    recording, on_cloth = recordings[0], cell.solver == "cloth"
    scenario = from_recording(recording, (9, 9) if on_cloth else COARSE)
    frames = dataset.kept_frames(recording.info.frames_used, dataset.Settings.num_frames)
    images = preprocess.of_clouds(trained.view, recording, frames)
    stiffest = space(jnp.ones(space.dim, float))
    solver = None if on_cloth else material_points(scenario, stiffest)
    seen = estimator.Sighting.make(scenario, images, frames, space, trained, solver)
    return estimator.estimate(seen, num_calls=cell.spent.calls, seed=cell.repeat)


def _pinn(
    cell: EstimateCell, space: ParameterSpace, recordings: list[Recording], folder: Path
) -> Estimate:
    from r2s.estimation.pinn import from_clouds, from_pulls  # need flax
    from r2s.estimation.pinn.pulls import pull_from

    del folder
    if cell.scenario != "stretching":
        return from_clouds.estimate(recordings[0], space, key=jr.key(cell.repeat))
    angles = [getattr(source, "angle", None) or 0.0 for source in cell.sources]
    pulls = [
        pull_from(recording, float(np.radians(angle)))
        for recording, angle in zip(recordings, angles, strict=True)
    ]
    return from_pulls.estimate(pulls, space, key=jr.key(cell.repeat)).estimate


_ESTIMATORS = {"diffcloud": _diffcloud, "diffcp": _diffcp, "physnet": _physnet, "pinn": _pinn}
