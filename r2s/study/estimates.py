"""Tasks that estimate: each approach from each scenario, on either solver."""

import json
import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.random as jr

from r2s._util.files import source_hash, write_json
from r2s.estimation.default_spaces import Law, identified_law, with_law
from r2s.estimation.estimate import Estimate, as_json, from_json
from r2s.estimation.method import Budget, Method, default_space
from r2s.estimation.methods import METHODS
from r2s.estimation.physnet.method import TrainingBudget, train_network
from r2s.materials import prior
from r2s.recordings.recording import Recording
from r2s.study.configuration import AND, APPROACHES
from r2s.study.recordings import Source, read
from r2s.study.tasks import KEY_LENGTH, VERSIONS, Task, processor, result_files

ESTIMATE, NETWORK = "estimate.json", "network.eqx"
SHAPES = {"cloth": (9, 9), "mpm": (7, 7)}  # vertices of the simulated sheet
SOLVERS = {name: tuple(METHODS[name].supports) for name in APPROACHES}


@dataclass(frozen=True)
class Budgets:
    """The costs of estimates by approach, and of training PhysNet's network."""

    diffcloud: Budget = METHODS["diffcloud"].budget
    diffcp: Budget = METHODS["diffcp"].budget
    physnet: Budget = METHODS["physnet"].budget
    pinn: Budget = METHODS["pinn"].budget
    training: TrainingBudget = TrainingBudget()


@dataclass(frozen=True)
class TrainedNetwork(Task):
    """PhysNet's network for a scenario on a solver."""

    kind: ClassVar[str] = "networks"

    solver: str
    scenario: str
    budget: TrainingBudget = TrainingBudget()
    seed: int = 0

    @property
    def name(self) -> str:
        return f"physnet_{self.solver}_{self.scenario}"

    @property
    def compilation_group(self) -> str:
        return f"networks {self.solver} {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Train the network."""
        trained = train_network(out / NETWORK, self.scenario, self.solver, self.budget, self.seed)
        return {"seed": self.seed, "triplet_accuracy": trained.curve[-1].accuracy}


@dataclass(frozen=True)
class EstimateTask(Task):
    """An estimate of a fabric.

    - `approach`: "diffcloud", "diffcp", "physnet" or "pinn", or "-published" behind one of these.
    - `solver`: "cloth" or "mpm".
    - `sources`: one recording, or several for approaches that accept them.
    - `density`: areal density as weighed, [kg/m^2].
    - `network`: of "physnet" and "physnet-published".
    - `informed`: as `r2s estimate`, with the prior of fabrics of this weight
      (`r2s.materials.prior`), and on meshes that resolve the fabric; else flat, and on `SHAPES`.
    - `law`: as in `with_law`; "identified": that which the recordings identify (`identified_law`).
    """

    kind: ClassVar[str] = "estimates"
    settings: ClassVar[tuple[Any, ...]] = (SHAPES,)

    approach: str
    solver: str
    fabric: str
    sources: tuple[Source, ...]
    density: float
    budget: Budget
    network: TrainedNetwork | None = None
    repeat: int = 0
    informed: bool = False
    law: Law | Literal["identified"] = "linear"

    @property
    def scenario(self) -> str:
        """The scenarios of its recordings, as in `Configuration.estimated_from`."""
        return AND.join(dict.fromkeys(source.scenario for source in self.sources))

    @property
    def name(self) -> str:
        return f"{self.approach}_{self.solver}_{self.scenario}_{self.fabric}_{self.repeat}"

    @property
    def compilation_group(self) -> str:
        return f"estimates {self.approach} {self.solver} {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """An estimate; one whose simulations all diverged is a result too, and says so."""
        recordings = [read(source, folder) for source in self.sources]
        space = with_law(default_space(self.solver, self.density), self.law_from(recordings))
        if self.informed:
            space = prior.informed(space, self.density)
        try:
            estimate = self._estimated(recordings, space, folder)
        except jax.errors.JaxRuntimeError:  # such as out of memory: no result, to be tried again
            raise
        except (RuntimeError, FloatingPointError) as error:
            return {"seed": self.repeat, "diverged": f"{error}"}
        write_json(out / ESTIMATE, as_json(estimate))
        return {"seed": self.repeat, "diverged": ""}

    def law_from(self, recordings: Sequence[Recording]) -> Law:
        """The law of the fabrics that are searched."""
        return identified_law(recordings) if self.law == "identified" else self.law

    def begun(self, folder: Path) -> Path:
        """The state of an unfinished estimate, from which the same source, versions and processor
        continue it after a kill."""
        made_by = sha256(f"{source_hash()} {VERSIONS} {processor()}".encode()).hexdigest()
        return folder / "begun" / f"{self.name}-{self.key}-{made_by[:KEY_LENGTH]}"

    def _estimated(self, recordings, space, folder: Path) -> Estimate:
        key, network, begun = jr.key(self.repeat), self.network, self.begun(folder)
        with nullcontext() if network is None else result_files(network, folder) as files:
            method = replace(method_of(self, files), checkpoint=begun / "state.npz")
            estimate = method.estimate(recordings, space, self.budget, key=key)
        shutil.rmtree(begun, ignore_errors=True)
        return estimate


def method_of(task: EstimateTask, network: Path | None = None) -> Method:
    """The method of a task; `network`: the folder of a trained one, which "physnet" needs to
    estimate."""
    kind = METHODS[task.approach]
    options: dict[str, Any] = {"shape": None if task.informed else SHAPES[task.solver]}
    if "network" in kind.options():
        options["network"] = network and network / NETWORK
    return kind(solver=task.solver, **options)


def read_estimate(task: EstimateTask, folder: Path) -> Estimate | None:
    """The estimate of a finished task; None where it diverged."""
    with result_files(task, folder) as files:
        if not (files / ESTIMATE).exists():
            return None
        return from_json(json.loads((files / ESTIMATE).read_text(encoding="utf-8")))
