"""What the distances to a surface say of a fabric: up to the horizon, beside the floor, as skill.

Beyond the horizon features that do not depend on the phase are compared
(`r2s.metrics.horizon`).
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
from r2s.study.ensembles import EnsembleCell, ensemble_of, read_ensemble
from r2s.study.evaluations import EvaluationCell, read_distances, read_motions
from r2s.study.mujoco_cells import MujocoEnsemble, MujocoRecording
from r2s.study.sources import Source, SyntheticRecording, read

SURFACE = "surface"  # the metric that is judged within the horizon
BEYOND = "beyond "  # before the name of a feature that is compared from the horizon on
FEWEST = 4  # frames that are compared beyond it
# of recordings that were simulated
ENSEMBLES = {SyntheticRecording: ensemble_of, MujocoRecording: MujocoEnsemble}


class Judged(NamedTuple):
    """What is known of a motion that is judged by.

    - `times`: of the frames that count, [s]. `floor`: of each, [m]. `horizon`: [s].
    """

    times: Float[np.ndarray, " frame"]
    floor: Float[np.ndarray, " frame"]
    horizon: float

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon."""
        return within(self.times, self.horizon)


def ensembles(cells: Iterable[EvaluationCell]) -> list[EnsembleCell | MujocoEnsemble]:
    """Of all recordings that cells judge by and that were simulated."""
    sources = dict.fromkeys(source for cell in cells for source in cell.recordings)
    found = [_ensemble(each) for each in sources]
    return [each for each in found if each is not None]


def _ensemble(source: Source) -> EnsembleCell | MujocoEnsemble | None:
    make = ENSEMBLES.get(type(source))
    return None if make is None else make(source)


def judged_motions(cells: Iterable[EvaluationCell], folder: Path) -> dict[Source, Judged]:
    """What ensembles that are made say of each recording."""
    sources = [cell.recording for cell in ensembles(cells)]
    found = {source: judged_motion(source, folder) for source in sources}
    return {source: judged for source, judged in found.items() if judged is not None}


def judged_motion(source: Source, folder: Path) -> Judged | None:
    """What the ensemble of a recording says of it; None where there is none, or it is not made."""
    cell = _ensemble(source)
    if cell is None or not cell.is_made(folder):
        return None
    ensemble = read_ensemble(cell, folder)
    first, last = read(source, folder).info.frames_used
    used = slice(first, last + 1)
    floor, times = floor_of(ensemble.causes)[used], ensemble.times[used]
    return Judged(times, floor, horizon_of(times, floor, ensemble.apart[:, used]))


def verdicts(
    cell: EvaluationCell, known: Mapping[Source, Judged], folder: Path
) -> dict[str, list[dict[str, Any]]]:
    """What a cell that is made says of its recordings whose motion is judged, by their names.

    Each has the metric, unit and value of an error: first that of `SURFACE` with floor and horizon,
    then those of what is compared beyond the horizon. `known`: from `judged_motions`.
    """
    sources = [source for source in cell.recordings if source in known]
    if not sources:
        return {}
    distances, x = read_distances(cell, folder), read_motions(cell, folder)
    found = {}
    for source in sources:
        judged = known[source]
        surface = {"metric": SURFACE, "unit": "m", **within_horizon(distances[source.name], judged)}
        recording = read(source, folder)
        found[source.name] = [surface, *_beyond(recording, x[source.name], cell.shape, judged)]
    return found


def within_horizon(away: Float[np.ndarray, " frame"], judged: Judged) -> dict[str, Any]:
    """The mean of distances [m] before the horizon, beside the floor's; NaN for a run that
    diverged, whenever it did, and where no frame is before the horizon."""
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
    """So many points [m] of a sheet's whole surface in each frame, drawn anew in each, as those of
    a recording that is judged by are: so that extents, and what the centroid of points moves by
    chance, are alike in both, whatever the mesh."""
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
