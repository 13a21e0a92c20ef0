"""What a study was made with: truths, data, ranges, meshes and costs, as a section."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from r2s.estimation.default_spaces import FROM, fixed, with_law
from r2s.estimation.method import default_space
from r2s.materials.fold_length import fold_length
from r2s.scenarios.resolution import ENOUGH, mesh_error
from r2s.study.cells import read_metadata, with_dependencies
from r2s.study.ensembles import Ensemble, read_ensemble
from r2s.study.estimates import EstimateCell, method_of, read_estimate
from r2s.study.evaluations import EvaluationCell
from r2s.study.report.page import Section
from r2s.study.sources import SyntheticRecording, read, true_fabric
from r2s.study.verdicts import Judged, ensembles, judged_motions

LEAST = 2e-3  # [m]: what mesh and step may leave, mean up to the horizon
TRUTHS = (
    "Of every judged motion: until when it discriminates between fabrics and, mean up to there, "
    "its floor and the distances from it of the truth 0.1 % stiffer, with grippers 0.2 mm aside, "
    "on a finer mesh, in half the step, and of a sheet that hangs as predictions start it. It is "
    f"converged where mesh and step move it by less than {1e3 * LEAST:g} mm together, chaotic "
    "where stiffness and path do not; the ensemble of a fold has no layers, its truth has"
)
DATA = (
    "What every approach reads of its recordings; a difference between approaches may be that of "
    "their data, or of the prior"
)
RANGES = (
    "Ranges of what is estimated, and fixed values. Truths: geometric mean of the study's fabrics "
    "at small strain"
)
MESHES = (
    "The error that the mesh of each estimate leaves in the motion that it was made from, by its "
    f"own fabric; below {1e3 * ENOUGH:.0f} mm is fine"
)


def section(
    cells: Sequence[EvaluationCell], estimates: Sequence[EstimateCell], folder: Path
) -> Section:
    """What a study was made with; `estimates`: those that are made."""
    found = {
        "truths": (TRUTHS, truth_table(cells, folder)),
        "data": (DATA, data_table(estimates, folder)),
        "ranges": (RANGES, range_table(cells)),
        "meshes": (MESHES, mesh_table(estimates, folder)),
        "costs": ("What it took, compilation included", cost_table(cells, folder)),
    }
    return Section("How it was made", (), {k: v for k, v in found.items() if len(v[1])})


def truth_table(cells: Sequence[EvaluationCell], folder: Path) -> pd.DataFrame:
    """How well each judged motion is known: horizon, floor by cause [mm] and a verdict."""
    known = judged_motions(cells, folder)
    rows = [
        {"recording": cell.recording.name, "horizon [s]": known[cell.recording].horizon}
        | _truth(known[cell.recording], read_ensemble(cell, folder), cell.lacks_layers)
        for cell in ensembles(cells)
        if cell.recording in known
    ]
    return pd.DataFrame(rows)


def _truth(judged: Judged, ensemble: Ensemble, is_layered: bool) -> dict[str, Any]:
    if not judged.inside.any():
        return {"verdict": "no frame is known"}
    inside = np.isin(ensemble.times, judged.times[judged.inside])
    left = {cause: float(each[:, inside].mean()) for cause, each in ensemble.causes.items()}
    words = verdict(*(left[cause] for cause in ("stiffness", "path", "mesh", "step")))
    floor = float(judged.floor[judged.inside].mean())
    shown = {f"{name} [mm]": 1e3 * length for name, length in ({"floor": floor} | left).items()}
    return {**shown, "verdict": "not known: layers" if is_layered else words}


def verdict(stiffness: float, path: float, mesh: float, step: float) -> str:
    """Of a truth, from the mean distances of its ensemble [m]."""
    if np.hypot(stiffness, path) > LEAST:
        return "chaotic"
    rest = float(np.hypot(mesh, step))
    return "converged" if rest <= LEAST else f"not converged: {1e3 * rest:.1f} mm"


def data_table(estimates: Iterable[EstimateCell], folder: Path) -> pd.DataFrame:
    """What each approach reads of the first of its recordings that are made."""
    rows = {}
    for cell in estimates:
        place = f"{cell.approach} on {cell.solver}", cell.scenario
        if place in rows or not all(source.is_made(folder) for source in cell.sources):
            continue
        recordings = [read(source, folder) for source in cell.sources]
        reads = [method_of(cell).reads(recording) for recording in recordings]
        rows[place] = {
            "approach": place[0],
            "motion": place[1],
            "recordings": len(recordings),
            "frames": ", ".join(dict.fromkeys(str(len(each.frames)) for each in reads)),
            "clouds": any(each.points != 0 for each in reads),
            "markers": any(each.markers for each in reads),
            "force of grippers": any(each.force for each in reads),
            "prior": cell.prior,
            "laws": cell.law_from(recordings),
        }
    return pd.DataFrame(list(rows.values()))


def range_table(cells: Iterable[EvaluationCell]) -> pd.DataFrame:
    """A line for each parameter of each solver, then for each number that stays as it is."""
    # what is estimated on points is predicted on the cloth, too
    cells = [c for c in cells if c.estimate is not None and c.solver == c.estimate.solver]
    rows = []
    for solver in dict.fromkeys(cell.solver for cell in cells):
        own = [cell for cell in cells if cell.solver == solver]
        laws = {cell.estimate.law for cell in own if cell.estimate is not None}
        law = "linear" if laws <= {"linear"} else "stiffening+softening"
        space = with_law(default_space(solver, own[0].density), law)
        sources = [source for cell in own for source in cell.recordings]
        synthetic = [each for each in sources if isinstance(each, SyntheticRecording)]
        names = dict.fromkeys(each.fabric for each in synthetic if not each.truth.materials)
        units = [space.to_unit(true_fabric(name, law)) for name in names]
        mean = np.mean(units, axis=0) if units else np.full(space.dim, np.nan)
        middle = space.values(jnp.full(space.dim, 0.5, float))
        truths = space.values(jnp.asarray(mean, float))
        for bound, half, truth in zip(space.ranges, middle.tolist(), truths.tolist(), strict=True):
            numbers = (bound.low, bound.high, half, truth)
            rows.append((solver, bound.name, bound.unit, *numbers, FROM.get(bound.name)))
        for density in dict.fromkeys(cell.density for cell in own):
            for each in fixed(default_space(solver, density)):
                row = (solver, each.name, each.unit, *(each.value,) * 3, np.nan, each.origin)
                rows += [row] if row not in rows else []
    header = ["solver", "parameter", "unit", "low", "high", "middle", "truths", "from"]
    return pd.DataFrame(rows, columns=header)


def mesh_table(estimates: Iterable[EstimateCell], folder: Path) -> pd.DataFrame:
    """What error the mesh of each estimate is expected to leave (`r2s.scenarios.resolution`)."""
    rows = []
    for cell in estimates:
        estimate = read_estimate(cell, folder)
        if estimate is None or estimate.shape is None:
            continue
        size = read(cell.sources[0], folder).info.sheet.size
        error = mesh_error(estimate.fabric, size, estimate.shape, cell.sources[0].scenario)
        bending_length = 1e3 * float(fold_length(estimate.fabric))
        rows.append((cell.name, " x ".join(map(str, estimate.shape)), bending_length, 1e3 * error))
    header = ["estimate", "mesh", "bending length [mm]", "expected error [mm]"]
    return pd.DataFrame(rows, columns=header)


def cost_table(cells: Iterable[EvaluationCell], folder: Path) -> pd.DataFrame:
    """What the cells that are made took, by group, with what they need and their ensembles."""
    groups, cells = defaultdict(list), list(cells)
    for cell in with_dependencies([*ensembles(cells), *cells]):
        if cell.is_made(folder):
            groups[cell.compilation_group].append(read_metadata(cell, folder))
    rows = []
    for group, noted in groups.items():
        seconds = [each["cpu_seconds"] for each in noted]
        memory = max(each["peak_memory_MB"] for each in noted)
        rows.append((group, len(noted), sum(seconds), float(np.median(seconds)), memory))
    times = ["CPU seconds in all", "CPU seconds of one (median)"]
    return pd.DataFrame(rows, columns=["kind", "count", *times, "peak memory [MB]"])
