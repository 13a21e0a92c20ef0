"""Estimate from each real lift, and judge on the unseen fold: what is learnt, what is left?

python experiments/real_recordings.py recordings --density 0.15      # 20 minutes on one core

Errors [mm] are mean distances from the recording to the simulation: as written down, and "placed"
where it lies nearest (at most 30 mm and 0.3 rad off), which leaves the cameras out.
"""

from pathlib import Path

import jax
import numpy as np
from _common import frames_of, recorded_points, recordings_in, simulated_points
from _tables import Line, command_line, keep
from scipy.spatial import KDTree

import r2s
from r2s.estimation.diffcloud import DiffCloud
from r2s.evaluation import placement


def distance(real: list[np.ndarray], other: list[np.ndarray]) -> float:
    """Mean distance [mm] from recorded points to others."""
    pairs = zip(map(KDTree, other), real, strict=True)
    return 1e3 * float(np.mean([tree.query(points)[0].mean() for tree, points in pairs]))


def errors(name: str, real: list[np.ndarray], others: list[list[np.ndarray]]) -> Line:
    """Mean errors [mm] of several simulations: as written down, and placed."""
    found = []
    for other in others:
        place = placement.nearest(real, other)
        there = [placement.moved(place, points) for points in real]
        found.append((distance(real, other), distance(there, other)))
    written, placed = np.mean(found, axis=0)
    return {name: f"{written:.1f}", f"{name}, placed": f"{placed:.1f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/real_recordings.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    space, key = r2s.OrthotropicSpace.make(a.density), jax.random.key(0)
    lifts, folds = (recordings_in(a.recordings, name) for name in ("lift", "fold"))
    estimates = [DiffCloud().estimate([lift], space, key=key) for lift in lifts]
    lines: list[Line] = []
    for fold in folds:
        name, trial, frames = fold.info.fabric, fold.info.trial, frames_of(fold)
        pairs = zip(lifts, estimates, strict=True)
        alike = {r.info.fabric: e.fabric for r, e in pairs if r.info.trial == trial}
        moved = {of: simulated_points(fold, fabric) for of, fabric in alike.items()}
        again = [r for r in folds if r.info.fabric == name and r is not fold]
        compared = {"estimate": [moved.pop(name)], "other fabrics": list(moved.values())}
        compared["default fabric"] = [simulated_points(fold, space.middle())]
        compared["other trial"] = [recorded_points(other, frames) for other in again]
        lines.append({"recording": fold.info.name})
        for what in filter(compared.get, compared):
            lines[-1] |= errors(what, recorded_points(fold, frames), compared[what])
        keep(a.out, lines, "Real folds, predicted from lifts: mean distance [mm].")
