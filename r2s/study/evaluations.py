"""Tasks that evaluate a fabric in motions that its estimate never saw."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float

from r2s._util.files import write_json
from r2s.materials import prior
from r2s.materials.fabric import Fabric
from r2s.metrics import prediction_error
from r2s.metrics.prediction_error import Motion
from r2s.recordings.recording import Recording
from r2s.scenarios.resolution import EDGE, MEMBRANE_DAMPING, explicit_cloth, grid_around
from r2s.scenarios.scenario import Scenario, from_recording
from r2s.solvers.explicit.cloth import ExplicitCloth
from r2s.solvers.mpm.sheet import MPMCloth, longest_edge, stable_step
from r2s.study.configuration import ON_CLOTH, Configuration
from r2s.study.estimates import EstimateTask, read_estimate
from r2s.study.recordings import SETTLING, Shape, Source, read, read_start, started
from r2s.study.tasks import Task, result_files

MIDDLE = -1  # instead of the number of a sample: the prior median
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

    - `estimate`: whose fabric is evaluated; None: that of a sample, or the true one.
    - `solver`: "cloth", in explicit steps, or "mpm", on `SHAPES`. Estimates by MPM are
      evaluated on both, as only on the cloth all fabrics are simulated alike.
    - `density`: areal, [kg/m^2].
    - `recordings`: evaluated together, since they compile once.
    - `draw`: a number of `r2s.materials.prior.draws`, given the density; together these are the
      default, and each fabric has its own. `MIDDLE`: the median of that prior. None: the truth of
      synthetic recordings at small strain; of MuJoCo's sheet `r2s.study.mujoco.as_plate`.
    - `other`: whether `estimate` is that of another fabric, for comparison.
    - `every`: 1 compares all frames that count, 3 every third.
    """

    kind: ClassVar[str] = "evaluations"
    settings: ClassVar[tuple[Any, ...]] = (SHAPES, MOST, IMPLICIT, RETRIES, LADDER, SETTLING)

    estimate: EstimateTask | None
    solver: str
    density: float
    fabric: str
    recordings: tuple[Source, ...]
    draw: int | None = None
    other: bool = False
    every: int = 1

    @property
    def baseline(self) -> str:
        """As in `r2s.study.statistics.frame`."""
        if self.estimate is not None:
            if self.other:
                return "other_fabric"
            return "" if self.solver == self.estimate.solver else ON_CLOTH
        if self.draw is None:
            return "true"
        return "middle" if self.draw == MIDDLE else "default"

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
        return "" if self.draw in (None, MIDDLE) else str(self.draw)

    @property
    def name(self) -> str:
        whose = f"{self.baseline}{self.repeat}_{self.solver}_{self.fabric}"
        if self.estimate is not None:
            whose = self.estimate.name
        on = f"{self.fabric}_" if self.other else ""
        on += "cloth_" if self.baseline == ON_CLOTH else ""
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
            lost = [np.full((len(each.times), count, 3), np.nan) for each in recordings]
            motions = [Motion(x, "the estimate diverged") for x in lost]
        else:
            starts = [read_start(source, folder) for source in self.recordings]
            motions = predict(recordings, fabric, self.solver, starts)
        measured, diverged, steps, arrays = {}, {}, {}, {}
        for source, recording, motion in zip(self.recordings, recordings, motions, strict=True):
            # what cameras observe is cropped
            args = self.every, source.is_given, self.shape
            found = prediction_error.against_motion(recording, motion.x, *args)
            away = prediction_error.from_surface(recording, motion.x, self.shape)
            found["surface"] = float(np.mean(away))
            measured[source.name] = {
                name: value if math.isfinite(value) else None for name, value in found.items()
            }
            arrays |= {f"x {source.name}": np.asarray(motion.x, np.float32), source.name: away}
            if motion.failure:
                diverged[source.name] = motion.failure
            if motion.steps:
                steps[source.name] = motion.steps
        write_json(out / MEASURED, measured)
        np.savez_compressed(out / MOTION, **arrays)
        return {"diverged": diverged, "runs": len(recordings), "steps": steps}

    def _fabric(self, folder: Path) -> Fabric | None:
        if self.estimate is not None:
            found = read_estimate(self.estimate, folder)
            return None if found is None else found.fabric
        if self.draw is None:
            return self.recordings[0].small_strain_fabric
        if self.draw == MIDDLE:
            return prior.middle(self.density)
        key = jr.fold_in(jr.key(getattr(self.recordings[0], "seed", 0)), self.draw)
        drawn = prior.draws(self.density, 1, jr.fold_in(key, crc32(self.fabric.encode())))
        return jax.tree.map(lambda leaf: leaf[0], drawn)


def read_measured(task: EvaluationTask, folder: Path) -> dict[str, dict[str, float]]:
    """The metrics of each recording by name; NaN where the motion diverged."""
    with result_files(task, folder) as files:
        stored = json.loads((files / MEASURED).read_text(encoding="utf-8"))
    return {
        name: {metric: math.nan if value is None else value for metric, value in row.items()}
        for name, row in stored.items()
    }


def read_motions(
    task: EvaluationTask, folder: Path
) -> dict[str, Float[np.ndarray, "frame vertex 3"]]:
    """Positions [m] of all motions, by the name of their recording."""
    with result_files(task, folder) as files, np.load(files / MOTION) as stored:
        return {source.name: stored[f"x {source.name}"] for source in task.recordings}


def read_distances(task: EvaluationTask, folder: Path) -> dict[str, Float[np.ndarray, " frame"]]:
    """Distances [m] of each recording's points from the sheet, by its name, in frames that count;
    NaN where the motion diverged."""
    with result_files(task, folder) as files, np.load(files / MOTION) as stored:
        return {source.name: stored[source.name] for source in task.recordings}


def predict(
    recordings: list[Recording],
    fabric: Fabric,
    solver: str,
    starts: Sequence[Shape | None] = (),
) -> list[Motion]:
    """The motions of a fabric in recordings of one scenario.

    - `solver`: "cloth" in explicit steps, whose only error is that of their mesh (in implicit ones
      for fabrics that need more than `MOST`), or "mpm" for material points in one grid for all.
    - `starts`: of each recording the shape in its first frame [m], see
      `r2s.study.recordings.started`; none: from flat sheets.
    """
    scenarios = [from_recording(each, SHAPES[solver]) for each in recordings]
    if starts:
        scenarios = [started(*each) for each in zip(scenarios, starts, strict=True)]
    most = max(scenario.substeps for scenario in scenarios)
    in_equal_steps = [dataclasses.replace(scenario, substeps=most) for scenario in scenarios]
    make = _points if solver == "mpm" else _explicit
    shared = make(in_equal_steps, fabric)
    if shared is None:
        words = "implicit steps, too stiff for explicit ones"
        return [_implicit(each, fabric)._replace(steps=words) for each in in_equal_steps]
    motions = []
    for scenario in in_equal_steps:
        own = eqx.tree_at(lambda s: s.scene, shared, scenario.scene)
        motions.append(_until_stable(scenario, fabric, own))
    return motions


def _until_stable(scenario: Scenario, fabric: Fabric, solver: ExplicitCloth | MPMCloth) -> Motion:
    """A motion; one of the cloth that diverges is repeated in shorter substeps, then in implicit
    steps.

    The limit of substeps is that of a sheet whose elements keep their shape. Some collapse where a
    soft sheet is flung, and that is no property of the fabric.
    """
    motion = prediction_error.predict_motion(scenario, fabric, solver)
    if not isinstance(solver, ExplicitCloth):
        return motion._replace(steps="material points")
    for times in RETRIES:
        if not motion.failure:
            break
        finer = dataclasses.replace(solver, substeps=times * solver.substeps)
        motion = prediction_error.predict_motion(scenario, fabric, finer)
        motion = motion._replace(steps=f"explicit steps, {times} times as many")
    if motion.failure:
        return _implicit(scenario, fabric)._replace(steps="implicit steps, lost in explicit ones")
    return motion if motion.steps else motion._replace(steps="explicit steps")


def _explicit(scenarios: list[Scenario], fabric: Fabric) -> ExplicitCloth | None:
    """None where there would be too many substeps."""
    solver = explicit_cloth(scenarios[0], fabric)
    return solver if solver.substeps / solver.dt <= MOST else None


def _implicit(scenario: Scenario, fabric: Fabric) -> Motion:
    steps = max(scenario.substeps, math.ceil(scenario.interval / IMPLICIT - 1e-9))
    return prediction_error.predict_motion(dataclasses.replace(scenario, substeps=steps), fabric)


def _points(scenarios: list[Scenario], fabric: Fabric) -> MPMCloth:
    first = scenarios[0]
    paths = [jnp.concatenate([getattr(s, name) for s in scenarios]) for name in ("path", "start")]
    everywhere = dataclasses.replace(first, path=paths[0], start=paths[1])
    spacing = longest_edge(first.scene.mesh) / EDGE
    limit = float(stable_step(first.scene.mesh, spacing, fabric, MEMBRANE_DAMPING))
    needed = max(first.substeps, first.interval / limit) + 1
    substeps = math.ceil(LADDER ** math.ceil(math.log(needed) / math.log(LADDER)))
    grid = grid_around(everywhere, spacing)
    return MPMCloth(first.scene, first.interval / substeps, fabric, grid, MEMBRANE_DAMPING)
