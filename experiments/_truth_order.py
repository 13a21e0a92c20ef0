"""The order by which a truth's error falls with its cells, and so the error itself."""

import numpy as np
from _tables import Line
from scipy.optimize import brentq

from r2s.evaluation.surface_distance import to_surface
from r2s.study.ensembles import points_of, simulated
from r2s.study.sources import SyntheticRecording, strain_dependent

CELLS = (32, 48, 64)
LOWEST, HIGHEST = 0.05, 6.0  # orders that are looked for


def line(motion: str, fabric: str) -> Line:
    """The line of a table."""
    source = SyntheticRecording(fabric, motion, 0, True)
    experiment, truth = source.experiment, strain_dependent(fabric, source.truth)
    shapes = [(count + 1, count + 1) for count in CELLS]
    start = simulated(experiment, truth, shapes[0]).x[0].reshape(*shapes[0], 3)
    found = [simulated(experiment, truth, shape, start=start) for shape in shapes]
    apart = [
        float(np.mean(to_surface(points_of(coarse), fine.x, fine.mesh.faces)))
        for coarse, fine in zip(found, found[1:], strict=False)
    ]
    order = order_of(*apart)
    whole = apart[0] / (1 - (CELLS[0] / CELLS[1]) ** order) if order else np.nan
    named = zip(CELLS, CELLS[1:], apart, strict=False)
    return {f"{a + 1} to {b + 1}": f"{1e3 * each:.2f}" for a, b, each in named} | {
        "order": f"{order:.2f}" if order else "none",
        "error of 33": f"{1e3 * whole:.2f}" if order else "not known",
        "over what 49 show": f"{whole / apart[0]:.2f}" if order else "-",
    }


def order_of(first: float, second: float) -> float | None:
    """The order by which two distances between three meshes fall; None where they do not."""
    a, b, c = (1 / count for count in CELLS)

    def off(p: float) -> float:
        return (b**p - c**p) / (a**p - b**p) - second / first

    if not off(LOWEST) > 0 > off(HIGHEST):
        return None
    return brentq(off, LOWEST, HIGHEST)  # pyright: ignore[reportReturnType]
