"""How accurately a motion for evaluation is known, and errors of predictions as far as it is.

The members of an ensemble differ from the truth by unmeasurable perturbations, or by mesh and time
step. Their distances from it over time give its floor and, with those of other fabrics, its horizon
(`r2s.metrics.horizon`). Errors count up to the horizon; beyond it features of the motion that do
not depend on the phase are compared.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import sample
from r2s.metrics import horizon as features
from r2s.metrics.horizon import floor_of, horizon_of, within
from r2s.metrics.losses import POINTS, to_surface
from r2s.recordings.recording import cloud
from r2s.scenarios.scenario import from_recording
from r2s.scenarios.standard import Experiment
from r2s.study.evaluations import EvaluationTask, Prediction
from r2s.study.recordings import SETTLING, Moved, SimulatedRecording, Source, read, read_start
from r2s.study.tasks import Task, result_files

ENSEMBLE = "ensemble.npz"
STIFFNESS, PATH = 1e-3, 2e-4  # [-] and [m], either way: below what can be measured
FINER, COARSER = 3 / 2, 1 / 2  # elements a side: of the finer mesh, and of other fabrics' sheets
APART = "apart "  # before the name of another fabric
WAYS = (1, -1)
SURFACE = "surface"  # the metric within the horizon
BEYOND = "beyond "  # before the name of a feature that is compared beyond it
FEWEST = 4  # frames that are compared beyond it


@dataclass(frozen=True)
class EnsembleTask(Task):
    """The ensemble of a simulated recording for evaluation, by its own simulator.

    A sheet of r2s that hangs starts in all members, as in predictions, in the truth's shape, and
    settles with the member's fabric. The effect of that alone is the cause `start`; other members
    are compared with the truth that settled again. No member of r2s has self-contact, to save time;
    neither has the truth that they are compared with. Other fabrics are compared with the truth's
    on half the elements, so that the mesh makes no difference between them.
    """

    kind: ClassVar[str] = "ensembles"
    settings: ClassVar[tuple[Any, ...]] = (STIFFNESS, PATH, FINER, COARSER, POINTS, SETTLING)

    recording: SimulatedRecording

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def compilation_group(self) -> str:
        return self.recording.compilation_group.replace("recordings", self.kind)

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Distances [m] of every member from the truth, or from it settled again, in each frame."""
        source: Any = self.recording
        fabric, shape, experiment = source.material, source.shape, source.experiment
        truth = source.simulate(fabric, shape, experiment)
        if not np.isfinite(truth.x).all():
            raise RuntimeError(f"the truth of {self.name} diverged")
        start = read_start(source, folder) if source.keeps_start else None
        simulate = partial(source.simulate, start=start)
        reference = truth if start is None else simulate(fabric, shape, experiment)
        members = {
            "stiffness": [
                simulate(source.stiffer(fabric, 1 + way * STIFFNESS), shape, experiment)
                for way in WAYS
            ],
            "path": [simulate(fabric, shape, shifted(experiment, way * PATH)) for way in WAYS],
            "mesh": [simulate(fabric, refined(shape, FINER), experiment)],
            "step": [simulate(fabric, shape, experiment, steps=2)],
        }
        points = points_of(reference)
        distances = {
            cause: [_distances(points, motion) for motion in motions]
            for cause, motions in members.items()
        }
        coarse = refined(shape, COARSER)
        points = points_of(simulate(fabric, coarse, experiment))
        for name, other in source.others.items():
            distances[APART + name] = [_distances(points, simulate(other, coarse, experiment))]
        recording = read(source, folder)
        clouds = [cloud(recording, frame) for frame in range(len(recording.times))]
        distances["recording"] = [_distances(clouds, truth)]
        if start is not None:
            distances["start"] = [_distances(points_of(truth), reference)]
        arrays = {name: np.stack(rows) for name, rows in distances.items()}
        stored: dict[str, Any] = {"times": np.asarray(experiment.times), **arrays}
        np.savez_compressed(out / ENSEMBLE, **stored)
        return {"diverged": [name for name, row in arrays.items() if not np.isfinite(row).all()]}


def _distances(points: list[np.ndarray], motion: Moved) -> Float[np.ndarray, " frame"]:
    return to_surface(points, motion.x, motion.mesh.faces)


def points_of(moved: Moved) -> list[np.ndarray]:
    """Points of the sheet in each frame, at the same material places in all."""
    faces = moved.mesh.faces
    resolution = max(math.ceil(math.sqrt(POINTS / len(faces))), 1)
    points = np.asarray(jax.vmap(lambda x: sample(x, faces, resolution))(jnp.asarray(moved.x)))
    chosen = np.random.default_rng(0).permutation(points.shape[1])[:POINTS]
    return list(points[:, chosen])


def shifted(experiment: Experiment, way: float) -> Experiment:
    """With the first gripper moved aside [m], and the last one the other way."""
    path = np.array(experiment.route.path, float)
    path[:, 0, 0] += way
    path[:, -1, 1] -= way
    return experiment._replace(route=experiment.route._replace(path=path))


def refined(shape: tuple[int, int], factor: float) -> tuple[int, int]:
    """Vertices of a mesh with `factor` times as many elements along either side."""
    rows, columns = (max(round(factor * (count - 1)), 1) + 1 for count in shape)
    return rows, columns


class Judged(NamedTuple):
    """How accurately a motion for evaluation is known.

    - `times`: of the frames, [s]. `floor`: of each, [m]. `horizon`: [s].
    - `causes`: distances of the members of its ensemble, `apart`: of other fabrics, [m].
    """

    times: Float[np.ndarray, " frame"]
    floor: Float[np.ndarray, " frame"]
    horizon: float
    causes: Mapping[str, Float[np.ndarray, "member frame"]] = {}
    apart: Float[np.ndarray, "other frame"] = np.zeros((0, 0))

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon."""
        return within(self.times, self.horizon)


def ensembles(tasks: Iterable[EvaluationTask]) -> list[EnsembleTask]:
    """The ensembles of all simulated recordings that tasks evaluate on."""
    sources = dict.fromkeys(source for task in tasks for source in task.recordings)
    return [EnsembleTask(source) for source in sources if isinstance(source, SimulatedRecording)]


def judged_motions(tasks: Iterable[EvaluationTask], folder: Path) -> dict[Source, Judged]:
    """Floor and horizon of each recording whose ensemble is finished."""
    judged: dict[Source, Judged] = {}
    for task in ensembles(tasks):
        if task.is_made(folder):
            with result_files(task, folder) as files, np.load(files / ENSEMBLE) as stored:
                causes = dict(stored)
            times, others = causes.pop("times"), [n for n in causes if n.startswith(APART)]
            apart = np.concatenate([causes.pop(name) for name in others])
            floor = floor_of(causes)
            horizon = horizon_of(times, floor, apart)
            judged[task.recording] = Judged(times, floor, horizon, causes, apart)
    return judged


def judged_errors(
    source: Source, prediction: Prediction, shape: tuple[int, int], judged: Judged, folder: Path
) -> list[dict[str, Any]]:
    """Metric, unit and value of the errors of a prediction on a mesh of a `shape`: `SURFACE` with
    floor and horizon, then the features beyond the horizon."""
    surface = {"metric": SURFACE, "unit": "m", **within_horizon(prediction.distances, judged)}
    outside = np.flatnonzero(~judged.inside)
    if len(outside) < FEWEST:
        return [surface]
    recording = read(source, folder)
    frames = outside + recording.info.frames_used[0]
    faces = from_recording(recording, shape).scene.mesh.faces
    real = [cloud(recording, int(frame)) for frame in frames]
    simulated = as_recorded(prediction.x[frames], faces, [len(points) for points in real])
    differences = features.differences(real, simulated, judged.times[outside])
    return [surface] + [
        {"metric": BEYOND + name, "unit": features.UNITS[name], "value": value}
        for name, value in differences.items()
    ]


def within_horizon(away: Float[np.ndarray, " frame"], judged: Judged) -> dict[str, Any]:
    """The mean of distances [m] before the horizon, and of the floor.

    NaN for a run that diverged at any time, and where no frame is before the horizon.
    """
    inside = judged.inside
    if not inside.any():
        return {"value": np.nan, "horizon": judged.horizon}
    value = np.mean(away[inside]) if np.isfinite(away).all() else np.nan
    floor = float(np.mean(judged.floor[inside]))
    return {"value": float(value), "floor": floor, "horizon": judged.horizon}


def as_recorded(
    x: Float[np.ndarray, "frame vertex 3"], faces: Int[Array, "face 3"], counts: Sequence[int]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Random points [m] of a sheet's whole surface in each frame, as many as its recording has.

    So extents and the noise of the centroid are the same in both, whatever the mesh.
    """
    generator = np.random.default_rng(0)
    resolution = math.ceil(math.sqrt(2 * max(counts) / len(faces)))
    every = np.asarray(jax.vmap(lambda at: sample(at, faces, resolution))(jnp.asarray(x, float)))
    return [
        points[generator.permutation(len(points))[:count]]
        for points, count in zip(every, counts, strict=True)
    ]
