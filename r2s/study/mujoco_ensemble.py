"""Cells of ensembles of MuJoCo's sheet: how well a motion of it is known that is judged by."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from r2s.evaluation.surface_distance import POINTS, to_surface
from r2s.recordings.recording import cloud
from r2s.scenarios.standard import Experiment
from r2s.study.cells import Cell
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
from r2s.study.mujoco_recording import MujocoRecording
from r2s.study.mujoco_sheet import Material, Resolution, moved
from r2s.study.sources import read

OTHERS = (0.25, 0.5, 2.0, 4.0)  # times as stiff: as the membranes of the presets differ


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
