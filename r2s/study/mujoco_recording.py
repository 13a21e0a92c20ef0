"""Cells of recordings that another simulator has made: a sheet of MuJoCo's flex."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import jax.random as jr
import numpy as np

from r2s.recordings.recording import save
from r2s.scenarios import synthetic
from r2s.scenarios.standard import Experiment
from r2s.study.cells import Cell
from r2s.study.drawn import RECORDING, START, experiment_of, number_of
from r2s.study.mujoco_sheet import GRIP, Material, Resolution, moved

FABRIC = "mujoco_flex"
SCENARIOS = ("lifting", "folding", "fling", "shaking")  # without fans and clamps


@dataclass(frozen=True)
class MujocoRecording(Cell):
    """A recording of a sheet of MuJoCo; what it shares with `SyntheticRecording` means the same.

    Its truth has no numbers in r2s's terms: it is there to be predicted.
    """

    kind: ClassVar[str] = "recordings"
    settings: ClassVar[tuple[Any, ...]] = (GRIP,)

    scenario: str
    number: int = 0
    unseen: bool = False
    seed: int = 0
    material: Material = Material()
    resolution: Resolution = Resolution()
    fabric: str = FABRIC

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ValueError(f"{FABRIC} has {', '.join(SCENARIOS)}, not {self.scenario}")

    @property
    def name(self) -> str:
        return f"{self.scenario}_{self.fabric}_{'u' * self.unseen}{self.number}"

    @property
    def compilation_group(self) -> str:
        return f"recordings of MuJoCo {self.scenario}"

    @property
    def sensing(self) -> synthetic.Sensing:
        """How cameras see it."""
        return synthetic.WHOLE if self.unseen else synthetic.sensing(self.experiment)

    @property
    def experiment(self) -> Experiment:
        """What is done to the sheet."""
        return experiment_of(self.scenario, self.number, self.unseen, self.seed)

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate the recording; raises as `r2s.study.mujoco_sheet.moved`."""
        experiment = self.experiment
        scenario = experiment.scenario(self.resolution.shape)
        key = jr.fold_in(
            jr.key(self.seed), number_of(self.fabric, self.scenario, self.number, self.unseen)
        )
        x = moved(scenario, self.material, self.resolution.step)
        if self.unseen and scenario.brake is not None:
            np.save(out / START, x[0].reshape(*self.resolution.shape, 3))
        made = synthetic.seen_of(
            jnp.asarray(x, float),
            experiment,
            scenario,
            self.fabric,
            self.number,
            self.sensing,
            key=key,
        )
        info = dataclasses.replace(
            made.info, name=self.name, source=f"MuJoCo's flex: {made.info.source}"
        )
        save(dataclasses.replace(made, info=info), out / RECORDING)
        return {"seed": self.seed, "frames": len(made.times)}
