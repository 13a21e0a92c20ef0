"""Cells that estimate: each approach from each scenario, on either solver."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.random as jr

from r2s.estimation.estimate import Estimate
from r2s.estimation.estimate_json import as_json, from_json
from r2s.estimation.method import Budget, Method, default_space
from r2s.estimation.physnet.method import TrainingBudget, train_network
from r2s.estimation.registry import METHODS
from r2s.fabrics.fabric import Fabric
from r2s.files import write_json
from r2s.study.cells import Cell, result_files
from r2s.study.sources import Source, read

ESTIMATE, NETWORK = "estimate.json", "network.eqx"
SHAPES = {"cloth": (9, 9), "points": (7, 7)}  # vertices of the simulated sheet
APPROACHES = ("diffcloud", "diffcp", "physnet", "pinn")
SOLVERS = {name: tuple(METHODS[name].supports) for name in APPROACHES}


@dataclass(frozen=True)
class Budgets:
    """What estimates may cost.

    - `coarse`, `starts`, `iterations`: of DIFFCLOUD, see `r2s.estimation.method.Budget`.
    - `points_coarse`, `points_starts`, `points_iterations`: likewise of DiffCP.
    - `calls`: simulations of PhysNet's search.
    - `fabrics`, `epochs`, `steps`: of the training of its network.
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
    budgets: Budgets = Budgets()
    seed: int = 0

    @property
    def name(self) -> str:
        return f"physnet_{self.solver}_{self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """A trained network; the simulated images are not kept."""
        budget = TrainingBudget(self.budgets.fabrics, self.budgets.epochs, self.budgets.steps)
        trained = train_network(out / NETWORK, self.scenario, self.solver, budget, self.seed)
        return {"seed": self.seed, "triplet_accuracy": trained.curve[-1].accuracy}


@dataclass(frozen=True)
class EstimateCell(Cell):
    """An estimate of a fabric.

    - `approach`: "diffcloud", "diffcp", "physnet" or "pinn".
    - `solver`: "cloth" or "points".
    - `sources`: the recordings, of one scenario; several for the pulls of "pinn" alone.
    - `density`: areal density as weighed, [kg/m^2].
    - `network`: of "physnet".
    """

    kind: ClassVar[str] = "estimates"
    weight: ClassVar[float] = 40.0

    approach: str
    solver: str
    fabric: str
    sources: tuple[Source, ...]
    density: float
    budgets: Budgets = Budgets()
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
    def compilation_group(self) -> str:
        return f"estimates {self.approach} {self.solver} {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """An estimate; one whose every simulation diverged is a result too, and says so."""
        recordings = [read(source, folder) for source in self.sources]
        space = default_space(self.solver, self.density)
        try:
            found = self._estimated(recordings, space, folder)
        except jax.errors.JaxRuntimeError:  # out of memory, say: no result, to be tried again
            raise
        except (RuntimeError, FloatingPointError) as error:
            return {"seed": self.repeat, "diverged": f"{error}"}
        write_json(out / ESTIMATE, as_json(found))
        return {"seed": self.repeat, "diverged": ""}

    def _estimated(self, recordings, space, folder: Path) -> Estimate:
        key, budget = jr.key(self.repeat), self._budget()
        if self.approach != "physnet":
            return self._method().estimate(recordings, space, budget, key=key)
        if self.network is None:
            raise ValueError("PhysNet needs a trained network")
        with result_files(self.network, folder) as files:
            method = self._method(network=files / NETWORK)
            return method.estimate(recordings, space, budget, key=key)

    def _method(self, **others: Any) -> Method:
        if self.approach == "pinn":
            others["angles"] = tuple(getattr(each, "angle", None) or 0.0 for each in self.sources)
        return METHODS[self.approach](solver=self.solver, shape=SHAPES[self.solver], **others)

    def _budget(self) -> Budget:
        budgets, usual = self.budgets, METHODS[self.approach].budget
        numbers = {
            "diffcloud": {
                "coarse": budgets.coarse,
                "starts": budgets.starts,
                "iterations": budgets.iterations,
            },
            "diffcp": {
                "coarse": budgets.points_coarse,
                "starts": budgets.points_starts,
                "iterations": budgets.points_iterations,
            },
            "physnet": {"evaluations": budgets.calls},
            "pinn": {},
        }
        return usual._replace(**numbers[self.approach])


def read_estimate(cell: EstimateCell, folder: Path) -> Estimate | None:
    """The estimate of a cell that is made; None where it diverged."""
    with result_files(cell, folder) as files:
        if not (files / ESTIMATE).exists():
            return None
        return from_json(json.loads((files / ESTIMATE).read_text(encoding="utf-8")))


def default_fabric(solver: str, density: float) -> Fabric:
    """What a study compares with: the middle of the space."""
    return default_space(solver, density).middle()
