"""Cells of another simulator, MuJoCo: recordings of a sheet of its flex, and their ensembles."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import jax.random as jr
import numpy as np

from r2s.materials.fabric import Fabric
from r2s.metrics.losses import POINTS, to_surface
from r2s.recordings.recording import cloud, save
from r2s.scenarios import synthetic
from r2s.scenarios.standard import Experiment
from r2s.study.cells import Cell
from r2s.study.drawn import RECORDING, START, number_of
from r2s.study.ensembles import (
    APART,
    COARSER,
    FINER,
    PATH,
    STIFFNESS,
    WAYS,
    Moved,
    cells_a_side,
    points_of,
    save_ensemble,
    shifted,
)
from r2s.study.mujoco_sheet import GRIP, Material, Resolution, as_plate, moved
from r2s.study.sources import SimulatedRecording, read

FABRIC = "mujoco_flex"
SCENARIOS = ("lifting", "folding", "fling", "shaking")  # without fans and clamps
OTHERS = (0.25, 0.5, 2.0, 4.0)  # times as stiff: as the membranes of the presets differ


@dataclass(frozen=True)
class MujocoRecording(SimulatedRecording):
    """A recording of a sheet of MuJoCo; what it shares with `SyntheticRecording` means the same.

    Its truth has no numbers in r2s's terms: it is there to be predicted.
    """

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
    def small_strain_fabric(self) -> Fabric | None:
        return as_plate(self.material)

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


@dataclass(frozen=True)
class MujocoEnsemble(Cell):
    """The ensemble of a recording of MuJoCo's sheet, as `r2s.study.ensembles.EnsembleCell` is that
    of a synthetic one.

    Every member is MuJoCo's, hangs and comes to rest by itself, and has contact of layers, as the
    recording has. What fabrics differ by is told by sheets of another Young's modulus.
    """

    kind: ClassVar[str] = "ensembles"
    settings: ClassVar[tuple[Any, ...]] = (STIFFNESS, PATH, FINER, COARSER, POINTS)
    lacks_layers: ClassVar[bool] = False

    recording: MujocoRecording
    others: tuple[float, ...] = OTHERS

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def compilation_group(self) -> str:
        return f"ensembles of MuJoCo {self.recording.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Distances [m] of every member from the truth in each frame.

        Raises as `r2s.study.mujoco_sheet.moved`, also where a member diverges.
        """
        source = self.recording
        experiment, material, (shape, step) = source.experiment, source.material, source.resolution
        base = _moved(experiment, material, source.resolution)
        here, points = source.resolution, points_of(base)

        def away(experiment: Experiment, material: Material, at: Resolution, points=points):
            found = _moved(experiment, material, at)
            return to_surface(points, found.x, found.mesh.faces)

        def stiffer(factor: float) -> Material:
            return material._replace(young=factor * material.young)

        recording = read(source, folder)
        clouds = [cloud(recording, frame) for frame in range(len(recording.times))]
        found = {
            "recording": [to_surface(clouds, base.x, base.mesh.faces)],
            "stiffness": [away(experiment, stiffer(1 + way * STIFFNESS), here) for way in WAYS],
            "path": [away(shifted(experiment, way * PATH), material, here) for way in WAYS],
            "mesh": [away(experiment, material, Resolution(cells_a_side(shape, FINER), step))],
            "step": [away(experiment, material, Resolution(shape, step / 2))],
        }
        coarse = Resolution(cells_a_side(shape, COARSER), step)
        own = points_of(_moved(experiment, material, coarse))
        for factor in self.others:
            found[f"{APART}{factor:g}"] = [away(experiment, stiffer(factor), coarse, own)]
        return save_ensemble(out, experiment, found)


def _moved(experiment: Experiment, material: Material, resolution: Resolution) -> Moved:
    scenario = experiment.scenario(resolution.shape)
    x = moved(scenario, material, resolution.step)
    return Moved(x, scenario.scene.mesh)
