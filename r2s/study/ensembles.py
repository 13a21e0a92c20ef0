"""Ensembles: how accurately a motion for evaluation is known, and how other fabrics move in it.

Members differ from the truth by unmeasurable perturbations, or by mesh and time step. Their
distances from it over time give its floor (`r2s.metrics.horizon`).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s.materials import presets
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.mesh.surface import sample
from r2s.metrics.losses import POINTS, to_surface
from r2s.recordings.recording import cloud
from r2s.scenarios.resolution import explicit_cloth
from r2s.scenarios.scenario import rollout
from r2s.scenarios.standard import Experiment
from r2s.study.recordings import (
    SETTLING,
    Shape,
    Source,
    SyntheticRecording,
    read,
    started,
    strain_dependent,
)
from r2s.study.tasks import Task, result_files

ENSEMBLE = "ensemble.npz"
STIFFNESS, PATH = 1e-3, 2e-4  # [-] and [m], either way: below what can be measured
FINER, COARSER = 3 / 2, 1 / 2  # elements a side: of the finer mesh, and of other fabrics' sheets
APART = "apart "  # before the name of another fabric
WAYS = (1, -1)

Own = TypeVar("Own")  # a fabric, in the terms of a simulator


class Moved(NamedTuple):
    """Positions [m] of the vertices of a mesh in the frames of a motion."""

    x: np.ndarray
    mesh: Mesh


@dataclass(frozen=True)
class EnsembleTask(Task):
    """The ensemble of a synthetic recording for evaluation.

    A sheet that hangs starts in all members, as in predictions, in the truth's shape, and settles
    with the member's fabric. The effect of that alone is the cause `start`; other members are
    compared with the truth that settled again. No member has self-contact, to save time; neither
    has the truth that they are compared with.

    - `others`: presets whose truths move in the same way. They and the truth's own fabric are
      simulated on half the elements, so that the mesh makes no difference between fabrics.
    """

    kind: ClassVar[str] = "ensembles"
    settings: ClassVar[tuple[Any, ...]] = (STIFFNESS, PATH, FINER, COARSER, POINTS, SETTLING)

    recording: SyntheticRecording
    others: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def compilation_group(self) -> str:
        return f"ensembles {self.recording.scenario}"

    @property
    def lacks_layers(self) -> bool:
        """Whether its recording has self-contact, which no member has."""
        return self.recording.has_layers

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Distances [m] of every member from the truth, or from it settled again, in each frame."""
        source = self.recording
        truth, experiment, shape = source.truth, source.experiment, source.truth.shape
        fabric = strain_dependent(source.fabric, truth)
        base = simulated(experiment, fabric, shape)
        if not np.isfinite(base.x).all():
            raise RuntimeError(f"the truth of {self.name} diverged")
        start = base.x[0].reshape(*shape, 3) if source.has_start else None

        def simulate(
            fabric: Fabric, shape: tuple[int, int], experiment: Experiment, steps: int = 1
        ) -> Moved:
            return simulated(experiment, fabric, shape, steps, start)

        settled = base if start is None else simulate(fabric, shape, experiment)
        others = {name: strain_dependent(name, truth) for name in self.others}
        found = member_distances(settled, fabric, shape, experiment, simulate, _scaled, others)
        found["recording"] = [recorded_distances(source, folder, base)]
        if start is not None:
            found["start"] = [to_surface(points_of(base), settled.x, settled.mesh.faces)]
        return save_ensemble(out, experiment, found)


class Ensemble(NamedTuple):
    """Distances [m] by cause, and of other fabrics, at times [s]."""

    times: Float[np.ndarray, " frame"]
    causes: dict[str, Float[np.ndarray, "member frame"]]
    apart: Float[np.ndarray, "other frame"]


def member_distances(
    reference: Moved,
    fabric: Own,
    shape: tuple[int, int],
    experiment: Experiment,
    simulate: Callable[..., Moved],
    scaled: Callable[[Own, float], Own],
    others: Mapping[str, Own],
) -> dict[str, list[Float[np.ndarray, " frame"]]]:
    """Distances [m] of the members of an ensemble from a reference, by cause.

    - `simulate`: called with a fabric, a shape, an experiment and how many `steps` for one.
    - `scaled`: a fabric that is stiffer by a factor.
    - `others`: further fabrics by name; their distances are from `fabric` on the same mesh.
    """
    points = points_of(reference)

    def away(moved: Moved, points: list[np.ndarray] = points) -> np.ndarray:
        return to_surface(points, moved.x, moved.mesh.faces)

    found = {
        "stiffness": [
            away(simulate(scaled(fabric, 1 + way * STIFFNESS), shape, experiment)) for way in WAYS
        ],
        "path": [away(simulate(fabric, shape, shifted(experiment, way * PATH))) for way in WAYS],
        "mesh": [away(simulate(fabric, refined(shape, FINER), experiment))],
        "step": [away(simulate(fabric, shape, experiment, steps=2))],
    }
    coarse = refined(shape, COARSER)
    own = points_of(simulate(fabric, coarse, experiment))
    for name, other in others.items():
        found[APART + name] = [away(simulate(other, coarse, experiment), own)]
    return found


def recorded_distances(source: Source, folder: Path, base: Moved) -> Float[np.ndarray, " frame"]:
    """Distances [m] of the points of a recording from a simulated sheet."""
    recording = read(source, folder)
    clouds = [cloud(recording, frame) for frame in range(len(recording.times))]
    return to_surface(clouds, base.x, base.mesh.faces)


def save_ensemble(
    out: Path, experiment: Experiment, found: Mapping[str, Sequence[np.ndarray]]
) -> dict[str, Any]:
    """Write distances [m] by cause and member; returns which diverged."""
    arrays = {name: np.stack(rows) for name, rows in found.items()}
    stored: dict[str, Any] = {"times": np.asarray(experiment.times), **arrays}
    np.savez_compressed(out / ENSEMBLE, **stored)
    return {"diverged": [name for name, row in arrays.items() if not np.isfinite(row).all()]}


def read_ensemble(task: Task, folder: Path) -> Ensemble:
    """The ensemble of a finished task."""
    with result_files(task, folder) as files, np.load(files / ENSEMBLE) as stored:
        arrays = dict(stored)
    times = arrays.pop("times")
    causes = {name: each for name, each in arrays.items() if not name.startswith(APART)}
    apart = [each for name, each in arrays.items() if name.startswith(APART)]
    return Ensemble(times, causes, np.concatenate(apart))


def ensemble_of(recording: SyntheticRecording) -> EnsembleTask:
    """The ensemble of a recording, with all other presets as other fabrics."""
    others = tuple(name for name in presets.FIVE if name != recording.fabric)
    return EnsembleTask(recording, others)


_rollout = eqx.filter_jit(rollout)


def simulated(
    experiment: Experiment,
    fabric: Fabric,
    shape: tuple[int, int],
    steps: int = 1,
    start: Shape | None = None,
) -> Moved:
    """A motion in explicit steps; NaN from where it diverged.

    `steps`: how many for one. `start`: see `r2s.study.recordings.started`.
    """
    scenario = started(experiment.scenario(shape), start)
    solver = explicit_cloth(scenario, fabric)
    solver = dataclasses.replace(solver, substeps=steps * solver.substeps)
    moved = _rollout(scenario, fabric, solver=solver)
    ok = np.logical_and.accumulate(np.asarray(moved.ok))[:, None, None]
    return Moved(np.where(ok, np.asarray(moved.x), np.nan), scenario.scene.mesh)


def points_of(moved: Moved) -> list[np.ndarray]:
    """Points of the sheet in each frame, at the same material places in all."""
    faces = moved.mesh.faces
    resolution = max(math.ceil(math.sqrt(POINTS / len(faces))), 1)
    points = np.asarray(jax.vmap(lambda x: sample(x, faces, resolution))(jnp.asarray(moved.x)))
    chosen = np.random.default_rng(0).permutation(points.shape[1])[:POINTS]
    return list(points[:, chosen])


def _scaled(fabric: Fabric, factor: float) -> Fabric:
    """A fabric whose membrane and bending energies are `factor` times as large.

    All laws of truths have a part `small` that is linear in its stiffnesses.
    """

    def where(f: Fabric) -> list:
        membrane = getattr(f.membrane, "small", f.membrane)
        bending = getattr(f.bending, "small", f.bending)
        return [membrane, bending.stiffness]

    parts = [jax.tree.map(lambda leaf: factor * leaf, part) for part in where(fabric)]
    return eqx.tree_at(where, fabric, parts)


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
