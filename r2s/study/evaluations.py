"""Tasks that evaluate a fabric in motions that its estimate never saw."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float

from r2s.materials import prior
from r2s.materials.fabric import Fabric
from r2s.metrics import prediction_error
from r2s.metrics.prediction_error import METRICS, Motion
from r2s.recordings.recording import Recording
from r2s.scenarios.resolution import EDGE, MEMBRANE_DAMPING, explicit_cloth, grid_around
from r2s.scenarios.scenario import Scenario, from_recording
from r2s.solvers.explicit.cloth import ExplicitCloth
from r2s.solvers.mpm.sheet import MPMCloth, longest_edge, stable_step
from r2s.study.configuration import ON_CLOTH, Configuration
from r2s.study.estimates import EstimateTask, read_estimate
from r2s.study.recordings import SETTLING, Shape, Source, read, read_start, started
from r2s.study.tasks import Task, result_files

MEASURED, MOTION = "measured.json", "motion.npz"
# vertices of the simulated sheet: with 25 x 25 of the cloth a fling of grey interlock is 7 mm off
SHAPES = {"cloth": (33, 33), "mpm": (9, 9)}
# substeps a second, above which implicit steps, of so many seconds, are three times as fast
MOST, IMPLICIT = 150_000, 1 / 240
RETRIES = (2, 4)  # times the substeps, of a prediction that diverged
LADDER = math.sqrt(2)  # steps between frames are powers of this: few programs to compile


@dataclass(frozen=True)
class EvaluationTask(Task):
    """The distance of simulations of a fabric from recordings of one scenario.

    - `estimate`: whose fabric is evaluated; None: that of a reference.
    - `solver`: "cloth", in explicit steps, or "mpm", on `SHAPES`.
    - `density`: areal, [kg/m^2].
    - `recordings`: evaluated together, since they compile once.
    - `baseline`: as in `r2s.study.results`. "default": a sample of the prior, given the density;
      "middle": its median; "true": the truth of synthetic recordings at small strain, of MuJoCo's
      sheet `r2s.study.mujoco.as_plate`. Estimates by MPM are evaluated on the cloth, too, since
      only there all fabrics have the same solver.
    - `draw`: the number of the sample (`r2s.materials.prior.draws`). Each fabric has its own.
    - `every`: 1 compares all frames that count, 3 every third.
    """

    kind: ClassVar[str] = "evaluations"
    settings: ClassVar[tuple[Any, ...]] = (
        *(SHAPES, MOST, IMPLICIT, RETRIES, LADDER, SETTLING),
        tuple(METRICS),
    )

    estimate: EstimateTask | None
    solver: str
    density: float
    fabric: str
    recordings: tuple[Source, ...]
    baseline: str = ""
    draw: int = 0
    every: int = 1

    @property
    def scenario(self) -> str:
        return self.recordings[0].scenario

    @property
    def configuration(self) -> Configuration:
        """That of the estimate; without one, of no approach on the solver (see `baseline`)."""
        if self.estimate is None:
            return Configuration("", self.solver, "")
        return Configuration(self.estimate.approach, self.solver, self.estimate.scenario)

    @property
    def repeat(self) -> str:
        """The number of the estimate or sample; "" where there is one."""
        if self.estimate is not None:
            return str(self.estimate.repeat)
        return str(self.draw) if self.baseline == "default" else ""

    @property
    def name(self) -> str:
        whose = f"{self.baseline}{self.repeat}_{self.solver}_{self.fabric}"
        if self.estimate is not None:
            whose = self.estimate.name
        on = "cloth_" if self.baseline == ON_CLOTH else ""
        return f"{whose}_on_{on}{self.scenario}_{self.recordings[0].name.split('_')[-1]}"

    @property
    def shape(self) -> tuple[int, int]:
        """Vertices of the simulated sheet along warp and weft."""
        return SHAPES[self.solver]

    @property
    def compilation_group(self) -> str:
        return f"evaluations {self.solver} {self.scenario}"

    @property
    def runs(self) -> int:
        return len(self.recordings)

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate every recording's motion: its metrics, the motion, its distances from the
        recording's points in the frames that count, and why a run diverged."""
        recordings = [read(source, folder) for source in self.recordings]
        fabric = self._fabric(folder)
        if fabric is None:
            count = self.shape[0] * self.shape[1]
            motions = [
                Motion(np.full((len(recording.times), count, 3), np.nan), "the estimate diverged")
                for recording in recordings
            ]
        else:
            starts = [read_start(source, folder) for source in self.recordings]
            motions = predict(recordings, fabric, self.solver, starts)
        measured, diverged, arrays = {}, {}, {}
        for source, recording, motion in zip(self.recordings, recordings, motions, strict=True):
            # what cameras observe is cropped
            metrics = prediction_error.against_motion(
                recording, motion.x, self.every, source.is_given, self.shape
            )
            distances = prediction_error.from_surface(recording, motion.x, self.shape)
            measured[source.name] = metrics | {"surface": float(np.mean(distances))}
            arrays |= {f"x {source.name}": np.asarray(motion.x, np.float32)}
            arrays |= {source.name: distances}
            if motion.failure:
                diverged[source.name] = motion.failure
        (out / MEASURED).write_text(json.dumps(measured), encoding="utf-8")
        np.savez_compressed(out / MOTION, **arrays)
        return {"diverged": diverged, "runs": len(recordings)}

    def _fabric(self, folder: Path) -> Fabric | None:
        if self.estimate is not None:
            estimate = read_estimate(self.estimate, folder)
            return None if estimate is None else estimate.fabric
        if self.baseline == "true":
            return self.recordings[0].small_strain_fabric
        if self.baseline == "middle":
            return prior.middle(self.density)
        key = jr.fold_in(jr.key(getattr(self.recordings[0], "seed", 0)), self.draw)
        drawn = prior.draws(self.density, 1, jr.fold_in(key, crc32(self.fabric.encode())))
        return jax.tree.map(lambda leaf: leaf[0], drawn)


class Prediction(NamedTuple):
    """What is stored of a recording; NaN where the motion diverged.

    - `metrics`: by name. `x`: positions of the motion, [m].
    - `distances`: of the recording's points from the sheet, in frames that count, [m].
    """

    metrics: dict[str, float]
    x: Float[np.ndarray, "frame vertex 3"]
    distances: Float[np.ndarray, " frame"]


def read_predictions(task: EvaluationTask, folder: Path) -> dict[str, Prediction]:
    """The predictions of a finished task by the name of their recording."""
    with result_files(task, folder) as files, np.load(files / MOTION) as stored:
        measured = json.loads((files / MEASURED).read_text(encoding="utf-8"))
        return {
            name: Prediction(metrics, stored[f"x {name}"], stored[name])
            for name, metrics in measured.items()
        }


def predict(
    recordings: list[Recording], fabric: Fabric, solver: str, starts: Sequence[Shape | None] = ()
) -> list[Motion]:
    """The motions of a fabric in recordings of one scenario.

    - `solver`: "cloth" in explicit steps, whose only error is that of their mesh (in implicit ones
      for fabrics that need more than `MOST`), or "mpm" for material points in one grid for all.
    - `starts`: of each recording the shape in its first frame [m], see
      `r2s.study.recordings.started`; none: from flat sheets.
    """
    scenarios = [from_recording(recording, SHAPES[solver]) for recording in recordings]
    if len({scenario.interval for scenario in scenarios}) > 1:  # cameras' own clocks
        own = list(starts) or [None] * len(recordings)
        pairs = zip(recordings, own, strict=True)
        return [m for r, start in pairs for m in predict([r], fabric, solver, [start])]
    if starts:
        scenarios = [started(*pair) for pair in zip(scenarios, starts, strict=True)]
    most = max(scenario.substeps for scenario in scenarios)
    scenarios = [dataclasses.replace(scenario, substeps=most) for scenario in scenarios]
    if solver == "mpm":
        points = _points(scenarios, fabric)
        return [
            prediction_error.predict_motion(
                scenario, fabric, eqx.tree_at(lambda s: s.scene, points, scenario.scene)
            )
            for scenario in scenarios
        ]
    cloth = explicit_cloth(scenarios[0], fabric)
    if cloth.substeps / cloth.dt > MOST:
        return [_implicit(scenario, fabric) for scenario in scenarios]
    return [_explicit(scenario, fabric, cloth) for scenario in scenarios]


def _explicit(scenario: Scenario, fabric: Fabric, cloth: ExplicitCloth) -> Motion:
    """A motion; one that diverges is repeated in shorter substeps, then in implicit steps.

    The limit of substeps is that of a sheet whose elements keep their shape. Some collapse where a
    soft sheet is flung, and that is no property of the fabric.
    """
    cloth = eqx.tree_at(lambda s: s.scene, cloth, scenario.scene)
    for times in (1, *RETRIES):
        finer = dataclasses.replace(cloth, substeps=times * cloth.substeps)
        motion = prediction_error.predict_motion(scenario, fabric, finer)
        if not motion.failure:
            return motion
    return _implicit(scenario, fabric)


def _implicit(scenario: Scenario, fabric: Fabric) -> Motion:
    steps = max(scenario.substeps, math.ceil(scenario.interval / IMPLICIT - 1e-9))
    return prediction_error.predict_motion(dataclasses.replace(scenario, substeps=steps), fabric)


def _points(scenarios: list[Scenario], fabric: Fabric) -> MPMCloth:
    """Material points in one grid and step for all scenarios."""
    first = scenarios[0]
    paths = [jnp.concatenate([getattr(s, name) for s in scenarios]) for name in ("path", "start")]
    everywhere = dataclasses.replace(first, path=paths[0], start=paths[1])
    spacing = longest_edge(first.scene.mesh) / EDGE
    limit = float(stable_step(first.scene.mesh, spacing, fabric, MEMBRANE_DAMPING))
    needed = max(first.substeps, first.interval / limit) + 1
    substeps = math.ceil(LADDER ** math.ceil(math.log(needed) / math.log(LADDER)))
    grid = grid_around(everywhere, spacing)
    return MPMCloth(first.scene, first.interval / substeps, fabric, grid, MEMBRANE_DAMPING)
