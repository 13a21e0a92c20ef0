"""What the distances to a surface say of a fabric: within the horizon, beside the floor, as skill.

Beyond the horizon, what does not depend on the phase is compared (`r2s.evaluation.phase_free`).
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.evaluation import phase_free
from r2s.evaluation.horizon import floor_of, horizon_of, skill, within
from r2s.geometry.surface import sample
from r2s.recordings.recording import cloud
from r2s.scenarios.scenario import from_recording
from r2s.study.ensembles import EnsembleCell, ensemble_of, read_ensemble
from r2s.study.evaluations import EvaluationCell, read_distances, read_motions
from r2s.study.mujoco_ensemble import MujocoEnsemble
from r2s.study.mujoco_recording import MujocoRecording
from r2s.study.rows import Row
from r2s.study.sources import Source, SyntheticRecording, read

SURFACE = "surface"  # the metric that is judged within the horizon
BEYOND = "beyond "  # before the name of a feature that is compared from the horizon on
FEWEST = 4  # frames that are compared beyond it


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
    if isinstance(source, SyntheticRecording):
        return ensemble_of(source)
    return MujocoEnsemble(source) if isinstance(source, MujocoRecording) else None


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


def with_verdicts(rows: Sequence[Row], cells: Sequence[EvaluationCell], folder: Path) -> list[Row]:
    """Rows in which those of `SURFACE` are judged within their horizon, beside floor and skill, and
    more rows of what is compared beyond it."""
    known = {source.name: each for source, each in judged_motions(cells, folder).items()}
    errors = {_place(row): row for row in rows if row.metric == SURFACE}
    more: list[Row] = []
    for cell in cells:
        if not cell.is_made(folder):
            continue
        for name, away in read_distances(cell, folder).items():
            place = (*cell.configuration, cell.fabric, cell.repeat, name, cell.baseline)
            if name in known and (row := errors.get(place)) is not None:
                errors[place] = _within(row, away, known[name])
                more += _beyond(row, cell, known[name], folder)
    told = _with_skills(list(errors.values()))
    replaced = {_place(row): row for row in told}
    return [replaced.get(_place(row), row) if row.metric == SURFACE else row for row in rows] + more


def _place(row: Row) -> tuple[str, ...]:
    return (
        row.approach,
        row.solver,
        row.estimated_from,
        row.fabric,
        row.repeat,
        row.recording,
        row.baseline,
    )


def _within(row: Row, away: Float[np.ndarray, " frame"], judged: Judged) -> Row:
    inside = judged.inside
    if not inside.any():
        return replace(row, value=np.nan, horizon=judged.horizon)
    is_lost = not np.isfinite(away).all()  # what diverges later is lost, too
    value, floor = np.nan if is_lost else np.mean(away[inside]), np.mean(judged.floor[inside])
    return replace(row, value=float(value), floor=float(floor), horizon=judged.horizon)


def _with_skills(rows: list[Row]) -> list[Row]:
    """With the skill of each beside the default's mean error in the same recording and solver.

    The mean is over the draws that did not diverge: one that did would end the skill of all, of
    what diverged itself too.
    """
    defaults: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for row in rows:
        if row.baseline == "default":
            defaults[row.solver, row.fabric, row.recording].append(row.value)
    found = []
    for row in rows:
        default = defaults.get((row.solver, row.fabric, row.recording))
        if row.floor is None or row.baseline == "default" or default is None:
            found.append(row)
            continue
        finite = [value for value in default if np.isfinite(value)] or [np.nan]
        told = skill(row.value, float(np.mean(finite)), row.floor)
        found.append(replace(row, skill=None if np.isnan(told) else told))
    return found


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


def _beyond(row: Row, cell: EvaluationCell, judged: Judged, folder: Path) -> list[Row]:
    outside = np.flatnonzero(~judged.inside)
    if len(outside) < FEWEST:
        return []
    (source,) = (each for each in cell.recordings if each.name == row.recording)
    recording = read(source, folder)
    frames = [recording.info.frames_used[0] + int(place) for place in outside]
    x = read_motions(cell, folder)[row.recording][frames]
    faces = from_recording(recording, cell.shape).scene.mesh.faces
    real = [cloud(recording, frame) for frame in frames]
    simulated = as_recorded(x, faces, [len(each) for each in real])
    found = phase_free.differences(real, simulated, judged.times[outside])
    return [
        replace(row, metric=BEYOND + name, unit=phase_free.UNITS[name], value=value)
        for name, value in found.items()
    ]
