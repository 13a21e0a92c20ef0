"""Cells of ensembles: how well a judged motion is known, and what other fabrics do in it.

Members differ from the truth by what no one can see, or by what its mesh and steps leave. Their
distances from it, over time, are its floor (`r2s.metrics.horizon`).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

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
from r2s.study.cells import Cell, result_files
from r2s.study.sources import SyntheticRecording, read, strain_dependent
from r2s.study.starts import SETTLING, started

ENSEMBLE = "ensemble.npz"
STIFFNESS, PATH = 1e-3, 2e-4  # [-] and [m], either way: what no one can tell
FINER, COARSER = 3 / 2, 1 / 2  # cells a side: of the finer mesh, and of other fabrics' sheets
APART = "apart "  # before the name of another fabric
WAYS = (1, -1)


@dataclass(frozen=True)
class EnsembleCell(Cell):
    """The ensemble of a synthetic recording that is judged by.

    A sheet that hangs starts in all members as the truth does, so that none buckles to another
    side; each comes to rest with its own fabric. So do predictions, and what that start alone does
    is a cause of its own (`start`): other members are compared with the truth started anew. No
    member has contact of layers, for the sake of
    time; a recording that has is compared with the truth without.

    - `others`: presets whose truths move in the same way; on half the cells, all of them and the
      truth's own fabric, so that what the mesh does is no difference between fabrics.
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
        """Whether its recording has contact of layers, which no member has."""
        return self.recording.has_layers

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Distances [m] of every member from the truth, or from it started anew, in each frame."""
        source = self.recording
        truth, experiment, shape = source.truth, source.experiment, source.truth.shape
        fabric = strain_dependent(source.fabric, truth)
        base = simulated(experiment, fabric, shape)
        if not np.isfinite(base.x).all():
            raise RuntimeError(f"the truth of {self.name} diverged")
        hangs = experiment.sheet.weft[2] != 0
        start = base.x[0].reshape(*shape, 3) if hangs else None  # as predictions do
        anew = simulated(experiment, fabric, shape, start=start) if hangs else base
        points = points_of(anew)

        def away(experiment: Experiment, fabric: Fabric, shape: Any, steps: int = 1) -> np.ndarray:
            moved = simulated(experiment, fabric, shape, steps, start)
            return to_surface(points, moved.x, moved.mesh.faces)

        recording = read(source, folder)
        clouds = [cloud(recording, frame) for frame in range(len(recording.times))]
        found = {
            "recording": [to_surface(clouds, base.x, base.mesh.faces)],
            "stiffness": [
                away(experiment, _scaled(fabric, 1 + way * STIFFNESS), shape) for way in WAYS
            ],
            "path": [away(shifted(experiment, way * PATH), fabric, shape) for way in WAYS],
            "mesh": [away(experiment, fabric, cells_a_side(shape, FINER))],
            "step": [away(experiment, fabric, shape, steps=2)],
        }
        if hangs:
            found["start"] = [to_surface(points_of(base), anew.x, anew.mesh.faces)]
        coarse = cells_a_side(shape, COARSER)
        own = points_of(simulated(experiment, fabric, coarse, start=start))
        for name in self.others:
            moved = simulated(experiment, strain_dependent(name, truth), coarse, start=start)
            found[APART + name] = [to_surface(own, moved.x, moved.mesh.faces)]
        return save_ensemble(out, experiment, found)


class Ensemble(NamedTuple):
    """What `EnsembleCell` found: distances [m] by cause, and of other fabrics, at times [s]."""

    times: Float[np.ndarray, " frame"]
    causes: dict[str, Float[np.ndarray, "member frame"]]
    apart: Float[np.ndarray, "other frame"]


def save_ensemble(
    out: Path, experiment: Experiment, found: Mapping[str, Sequence[np.ndarray]]
) -> dict[str, Any]:
    """Write distances [m] by cause and member; returns which diverged."""
    arrays = {name: np.stack(rows) for name, rows in found.items()}
    stored: dict[str, Any] = {"times": np.asarray(experiment.times), **arrays}
    np.savez_compressed(out / ENSEMBLE, **stored)
    return {"diverged": [name for name, row in arrays.items() if not np.isfinite(row).all()]}


def read_ensemble(cell: Cell, folder: Path) -> Ensemble:
    """The ensemble of a cell of this kind that is made."""
    with result_files(cell, folder) as files, np.load(files / ENSEMBLE) as stored:
        arrays = dict(stored)
    times = arrays.pop("times")
    causes = {name: each for name, each in arrays.items() if not name.startswith(APART)}
    apart = [each for name, each in arrays.items() if name.startswith(APART)]
    return Ensemble(times, causes, np.concatenate(apart))


def ensemble_of(recording: SyntheticRecording) -> EnsembleCell:
    """The ensemble of a recording, beside all other presets of the study."""
    others = tuple(name for name in presets.FIVE if name != recording.fabric)
    return EnsembleCell(recording, others)


class Moved(NamedTuple):
    """Positions [m] of the vertices of a mesh in the frames of a motion."""

    x: np.ndarray
    mesh: Mesh


_rollout = eqx.filter_jit(rollout)


def simulated(
    experiment: Experiment,
    fabric: Fabric,
    shape: tuple[int, int],
    steps: int = 1,
    start: Float[np.ndarray, "row column 3"] | None = None,
) -> Moved:
    """A motion in explicit steps; NaN from where it diverged.

    `steps`: times as many. `start`: see `r2s.study.starts`.
    """
    scenario = started(experiment.scenario(shape), start)
    solver = explicit_cloth(scenario, fabric)
    solver = dataclasses.replace(solver, substeps=steps * solver.substeps)
    moved = _rollout(scenario, fabric, solver=solver)
    ok = np.logical_and.accumulate(np.asarray(moved.ok))[:, None, None]
    return Moved(np.where(ok, np.asarray(moved.x), np.nan), scenario.scene.mesh)


def points_of(moved: Moved) -> list[np.ndarray]:
    """Points of the sheet in each frame, the same places of the fabric in all."""
    faces = moved.mesh.faces
    resolution = max(math.ceil(math.sqrt(POINTS / len(faces))), 1)
    points = np.asarray(jax.vmap(lambda x: sample(x, faces, resolution))(jnp.asarray(moved.x)))
    chosen = np.random.default_rng(0).permutation(points.shape[1])[:POINTS]
    return list(points[:, chosen])


def _scaled(fabric: Fabric, factor: float) -> Fabric:
    """A fabric whose energies of membrane and bending are `factor` times as large.

    All laws of truths have a part `small` that is linear in its stiffnesses.
    """

    def where(f: Fabric) -> list:
        membrane = getattr(f.membrane, "small", f.membrane)
        bending = getattr(f.bending, "small", f.bending)
        return [membrane, bending.stiffness]

    parts = [jax.tree.map(lambda leaf: factor * leaf, part) for part in where(fabric)]
    return eqx.tree_at(where, fabric, parts)


def shifted(experiment: Experiment, way: float) -> Experiment:
    """With the first gripper aside by so much [m], and the last one the other way."""
    path = np.array(experiment.route.path, float)
    path[:, 0, 0] += way
    path[:, -1, 1] -= way
    return experiment._replace(route=experiment.route._replace(path=path))


def cells_a_side(shape: tuple[int, int], factor: float) -> tuple[int, int]:
    """Vertices of a mesh with `factor` times as many cells along either side."""
    rows, columns = (max(round(factor * (count - 1)), 1) + 1 for count in shape)
    return rows, columns
