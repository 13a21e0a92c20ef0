"""How well the truth of every judged motion is known: horizon, floor by cause, convergence."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r2s.study.ensembles import Ensemble, read_ensemble
from r2s.study.evaluations import EvaluationCell
from r2s.study.tables import MISSING, Table
from r2s.study.verdicts import Judged, ensembles, judged_motions

LEAST = 2e-3  # [m]: what mesh and step may leave, mean up to the horizon
LAYERS = "not known: layers"
HEADER = (
    *("recording", "horizon [s]", "floor [mm]"),
    *("stiffness [mm]", "path [mm]", "mesh [mm]", "step [mm]", "start [mm]", "verdict"),
)
CAPTION = (
    "Of every judged motion: until when it tells fabrics apart, and, mean up to there, its floor "
    "and the distances from it of the truth 0.1 % stiffer, with grippers 0.2 mm aside, on a finer "
    "mesh and in half the step, and of a sheet that hangs as predictions start it. It is called "
    f"converged where mesh and step move it by less than {1e3 * LEAST:g} mm together (the error "
    "itself is 1.8 times what 3/2 as many cells a side move, where it falls with their square, and "
    "3 times where it falls with their length), and chaotic where stiffness and path do not; a "
    "prediction nearer than the floor is not told from a better one. The ensemble of a fold has no "
    "layers, its truth has: whether that is "
    "converged is not known. Members of MuJoCo's sheet are MuJoCo's, with layers, its sheets of a "
    "quarter to four times the modulus are the other fabrics."
)


def truth_table(cells: Sequence[EvaluationCell], folder: Path) -> Table:
    """A line for each recording whose ensemble is made."""
    judged = judged_motions(cells, folder)
    lines = [
        _line(
            cell.recording.name,
            judged[cell.recording],
            read_ensemble(cell, folder),
            cell.lacks_layers,
        )
        for cell in ensembles(cells)
        if cell.recording in judged
    ]
    return Table(HEADER, tuple(lines), CAPTION)


def _line(name: str, judged: Judged, ensemble: Ensemble, is_layered: bool) -> tuple[str, ...]:
    horizon = "never" if np.isinf(judged.horizon) else f"{judged.horizon:.2f}"
    if not judged.inside.any():
        return name, horizon, *["-"] * 6, "no frame is known"
    inside = np.isin(ensemble.times, judged.times[judged.inside])
    left = {cause: float(each[:, inside].mean()) for cause, each in ensemble.causes.items()}
    means = [left[cause] for cause in ("stiffness", "path", "mesh", "step")]
    start = f"{1e3 * left['start']:.2f}" if "start" in left else MISSING
    floor = float(judged.floor[judged.inside].mean())
    words = LAYERS if is_layered else verdict(*means)
    return name, horizon, *(f"{1e3 * each:.2f}" for each in (floor, *means)), start, words


def verdict(stiffness: float, path: float, mesh: float, step: float) -> str:
    """Of a truth, from the mean distances of its ensemble [m]."""
    if np.hypot(stiffness, path) > LEAST:
        return "chaotic"
    rest = float(np.hypot(mesh, step))
    return "converged" if rest <= LEAST else f"not converged: {1e3 * rest:.1f} mm"
