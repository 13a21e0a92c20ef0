"""Cells that judge: a fabric in motions that its estimate never saw, beside recordings of them."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s.evaluation import prediction_error
from r2s.evaluation.prediction_error import Motion
from r2s.fabrics.fabric import Fabric
from r2s.files import write_json
from r2s.mpm.sheet import Sheet, longest_edge, stable_step
from r2s.recordings.recording import Recording
from r2s.scenarios.on_points import EDGE, MEMBRANE_DAMPING, grid_around
from r2s.scenarios.scenario import Scenario, from_recording
from r2s.study.cells import Cell, result_files
from r2s.study.configuration import Configuration
from r2s.study.estimates import EstimateCell, default_fabric, read_estimate
from r2s.study.sources import GivenRecording, Source, read

MEASURED, MOTION = "measured.json", "motion.npz"
LADDER = math.sqrt(2)  # steps between frames are powers of this: few programs to compile


@dataclass(frozen=True)
class EvaluationCell(Cell):
    """How near simulations of a fabric come to recordings of one scenario.

    - `estimate`: whose fabric is judged; None: the default one of `solver` with an areal `density`
      [kg/m^2].
    - `recordings`: what it is judged by, together, since they compile once.
    - `other`: whether `estimate` is that of another fabric, for comparison.
    - `every`: 1 compares all frames that count, 3 every third.
    """

    kind: ClassVar[str] = "evaluations"
    weight: ClassVar[float] = 8.0

    estimate: EstimateCell | None
    solver: str
    density: float
    fabric: str
    recordings: tuple[Source, ...]
    other: bool = False
    every: int = 1

    @property
    def scenario(self) -> str:
        """What is judged."""
        return self.recordings[0].scenario

    @property
    def configuration(self) -> Configuration:
        """Whose fabric it is: an approach's on a solver, or the default one."""
        if self.estimate is None:
            return Configuration("", self.solver, "")
        return Configuration(self.estimate.approach, self.solver, self.estimate.scenario)

    @property
    def repeat(self) -> str:
        """Which of several estimates alike; "" for the default fabric."""
        return "" if self.estimate is None else str(self.estimate.repeat)

    @property
    def name(self) -> str:
        whose = self.estimate.name if self.estimate else f"default_{self.solver}_{self.fabric}"
        on = f"{self.fabric}_" if self.other else ""
        return f"{whose}_on_{on}{self.scenario}_{self.recordings[0].name.split('_')[-1]}"

    @property
    def compilation_group(self) -> str:
        return f"evaluations {self.solver} {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate every recording's motion: metrics of each, the motion beside the first, and why
        a run diverged."""
        recordings = [read(source, folder) for source in self.recordings]
        fabric = self._fabric(folder)
        if fabric is None:
            lost = np.full((len(recordings[0].times), 81, 3), np.nan)
            motions = [Motion(lost, "the estimate diverged")] * len(recordings)
        else:
            motions = predict(recordings, fabric, self.solver)
        measured, diverged = {}, {}
        for source, recording, motion in zip(self.recordings, recordings, motions, strict=True):
            is_cropped = isinstance(source, GivenRecording)
            found = prediction_error.against_motion(recording, motion.x, self.every, is_cropped)
            measured[source.name] = {name: _json_number(value) for name, value in found.items()}
            if motion.failure:
                diverged[source.name] = motion.failure
        write_json(out / MEASURED, measured)
        np.savez_compressed(out / MOTION, x=np.asarray(motions[0].x, np.float32))
        return {"diverged": diverged, "runs": len(recordings)}

    def _fabric(self, folder: Path) -> Fabric | None:
        if self.estimate is None:
            return default_fabric(self.solver, self.density)
        found = read_estimate(self.estimate, folder)
        return None if found is None else found.fabric


def read_measured(cell: EvaluationCell, folder: Path) -> dict[str, dict[str, float]]:
    """The metrics of each recording by name; NaN where the motion diverged."""
    with result_files(cell, folder) as files:
        stored = json.loads((files / MEASURED).read_text(encoding="utf-8"))
    return {
        name: {metric: math.nan if value is None else value for metric, value in row.items()}
        for name, row in stored.items()
    }


def read_motion(cell: EvaluationCell, folder: Path) -> Float[np.ndarray, "frame vertex 3"]:
    """Positions [m] of the motion beside the first recording."""
    with result_files(cell, folder) as files, np.load(files / MOTION) as stored:
        return stored["x"]


def predict(recordings: list[Recording], fabric: Fabric, solver: str) -> list[Motion]:
    """The motions of a fabric in recordings of one scenario.

    `solver`: "cloth", or "points" for material points in a grid that serves all recordings.
    """
    scenarios = [from_recording(recording) for recording in recordings]
    most = max(scenario.substeps for scenario in scenarios)
    in_equal_steps = [dataclasses.replace(scenario, substeps=most) for scenario in scenarios]
    sheet = _points(in_equal_steps, fabric) if solver == "points" else None
    motions = []
    for scenario in in_equal_steps:
        own = sheet and eqx.tree_at(lambda s: s.scene, sheet, scenario.scene)
        motions.append(prediction_error.predict_motion(scenario, fabric, own))
    return motions


def _points(scenarios: list[Scenario], fabric: Fabric) -> Sheet:
    paths = [jnp.concatenate([getattr(s, name) for s in scenarios]) for name in ("path", "start")]
    everywhere = dataclasses.replace(scenarios[0], path=paths[0], start=paths[1])
    first = scenarios[0]
    mesh = first.scene.mesh
    spacing = longest_edge(mesh) / EDGE
    limit = float(stable_step(mesh, spacing, fabric, MEMBRANE_DAMPING))
    needed = max(first.substeps, first.interval / limit) + 1
    substeps = math.ceil(LADDER ** math.ceil(math.log(needed) / math.log(LADDER)))
    grid = grid_around(everywhere, spacing)
    return Sheet.make(first.scene, grid, fabric, first.interval / substeps, MEMBRANE_DAMPING)


def _json_number(value: float) -> float | None:
    return value if math.isfinite(value) else None
