"""Errors of predictions up to the horizon, with their floor; beyond it, features of the motion.

Beyond the horizon features that do not depend on the phase are compared (`r2s.metrics.horizon`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.surface import sample
from r2s.metrics import horizon
from r2s.metrics.horizon import floor_of, horizon_of, within
from r2s.recordings.recording import Recording, cloud
from r2s.scenarios.scenario import from_recording
from r2s.study.ensembles import EnsembleTask, ensemble_of, read_ensemble
from r2s.study.evaluations import EvaluationTask, read_distances, read_motions
from r2s.study.mujoco import MujocoEnsemble, MujocoRecording
from r2s.study.recordings import Source, SyntheticRecording, read

SURFACE = "surface"  # the metric within the horizon
BEYOND = "beyond "  # before the name of a feature that is compared beyond it
FEWEST = 4  # frames that are compared beyond it


class Judged(NamedTuple):
    """How accurately a motion for evaluation is known.

    - `times`: of the frames that count, [s]. `floor`: of each, [m]. `horizon`: [s].
    """

    times: Float[np.ndarray, " frame"]
    floor: Float[np.ndarray, " frame"]
    horizon: float

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon."""
        return within(self.times, self.horizon)


def ensembles(tasks: Iterable[EvaluationTask]) -> list[EnsembleTask | MujocoEnsemble]:
    """The ensembles of all simulated recordings that tasks evaluate on."""
    sources = dict.fromkeys(source for task in tasks for source in task.recordings)
    return [found for each in sources if (found := _ensemble(each)) is not None]


def _ensemble(source: Source) -> EnsembleTask | MujocoEnsemble | None:
    if isinstance(source, SyntheticRecording):
        return ensemble_of(source)
    return MujocoEnsemble(source) if isinstance(source, MujocoRecording) else None


def judged_motions(tasks: Iterable[EvaluationTask], folder: Path) -> dict[Source, Judged]:
    """`judged_motion` of each recording whose ensemble is finished."""
    found = {task.recording: judged_motion(task.recording, folder) for task in ensembles(tasks)}
    return {source: judged for source, judged in found.items() if judged is not None}


def judged_motion(source: Source, folder: Path) -> Judged | None:
    """Floor and horizon of a recording; None where its ensemble is missing."""
    task = _ensemble(source)
    if task is None or not task.is_made(folder):
        return None
    ensemble = read_ensemble(task, folder)
    first, last = read(source, folder).info.frames_used
    used = slice(first, last + 1)
    floor, times = floor_of(ensemble.causes)[used], ensemble.times[used]
    return Judged(times, floor, horizon_of(times, floor, ensemble.apart[:, used]))


def verdicts(
    task: EvaluationTask, known: Mapping[Source, Judged], folder: Path
) -> dict[str, list[dict[str, Any]]]:
    """Metric, unit and value of the errors of a finished task, by the names of its recordings.

    First comes `SURFACE` with floor and horizon, then the features beyond the horizon. `known`:
    from `judged_motions`; other recordings are left out.
    """
    sources = [source for source in task.recordings if source in known]
    if not sources:
        return {}
    distances, x = read_distances(task, folder), read_motions(task, folder)
    found = {}
    for source in sources:
        judged = known[source]
        surface = {"metric": SURFACE, "unit": "m", **within_horizon(distances[source.name], judged)}
        recording = read(source, folder)
        found[source.name] = [surface, *_beyond(recording, x[source.name], task.shape, judged)]
    return found


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
    x: Float[np.ndarray, "frame vertex 3"],
    faces: Int[Array, "face 3"],
    counts: Sequence[int],
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


def _beyond(
    recording: Recording,
    x: Float[np.ndarray, "frame vertex 3"],
    shape: tuple[int, int],
    judged: Judged,
) -> list[dict[str, Any]]:
    outside = np.flatnonzero(~judged.inside)
    if len(outside) < FEWEST:
        return []
    frames = [recording.info.frames_used[0] + int(place) for place in outside]
    faces = from_recording(recording, shape).scene.mesh.faces
    real = [cloud(recording, frame) for frame in frames]
    simulated = as_recorded(x[frames], faces, [len(each) for each in real])
    found = horizon.differences(real, simulated, judged.times[outside])
    return [
        {"metric": BEYOND + name, "unit": horizon.UNITS[name], "value": value}
        for name, value in found.items()
    ]
