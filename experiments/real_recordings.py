"""Estimate from each real lift, and judge on the unseen fold: what is learnt, what is left?

python experiments/real_recordings.py recordings --density 0.15      # two hours on one core
python experiments/real_recordings.py recordings --prior fabrics --lifts-alone    # one hour

Errors [mm] are mean distances both ways between a recording and what its cameras would have seen of
a simulation: as read, and "placed" where the recording lies nearest (at most 30 mm and 0.3 rad
off), which leaves the cameras out. The prior's draws know the weight alone. Estimates are kept in
the folder --kept, and not made again. With --prior fabrics an estimate knows beforehand what
measured fabrics of the weight are like; --lifts-alone leaves out estimates from the folds.
"""

from pathlib import Path

import jax
import numpy as np
from _common import frames_of, recorded_points, recordings_in
from _real import beside, compared, errors, estimated
from _tables import command_line, keep

import r2s
from r2s.fabrics import prior

DRAWS = 8

if __name__ == "__main__":
    parser = command_line(__doc__, "results/real_recordings.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    parser.add_argument("--kept", type=Path, default=Path("results/real_estimates"))
    parser.add_argument("--shape", type=int, nargs=2, default=(9, 9), help="vertices")
    parser.add_argument("--prior", choices=("flat", "fabrics"), default="flat")
    parser.add_argument("--lifts-alone", action="store_true")
    a = parser.parse_args()
    shape, space = tuple(a.shape), r2s.OrthotropicSpace.make(a.density)
    if a.prior == "fabrics":
        space = prior.informed(space, a.density)
    draws = prior.fabrics(a.density, DRAWS, jax.random.key(0))
    lifts, folds = (recordings_in(a.recordings, name) for name in ("lift", "fold"))
    learnt = lifts if a.lifts_alone else [*lifts, *folds]
    made = {r.info.name: (r.info, estimated(r, space, shape, a.kept)) for r in learnt}
    table: dict[str, dict[str, float]] = {}
    for fold in folds:
        info, real = fold.info, recorded_points(fold, frames_of(fold))
        moved = beside(fold, made.values(), draws, shape)
        again = [r for r in folds if r.info.fabric == info.fabric and r is not fold]
        moved["other trial"] = [recorded_points(r, frames_of(fold)) for r in again]
        row = {}
        for name in filter(moved.get, moved):
            row[name], row[f"{name}, placed"] = errors(real, moved[name])
        table[info.name] = row
        means = {n: np.mean([row[n] for row in table.values()]) for n in row}
        rows = [*table.items(), ("mean", means)]
        lines = [{"recording": n} | {k: f"{v:.1f}" for k, v in r.items()} for n, r in rows]
        keep(a.out, lines, "Real folds, predicted from lifts: mean distance both ways [mm].")
    fabrics, tests = [fold.info.fabric for fold in folds], []
    for end in ("", ", placed"):
        for other in ("prior", "other fabrics' lifts", "other trial"):
            tests.append(compared(table, fabrics, f"own lift{end}", f"{other}{end}"))
    keep(a.out.with_stem(f"{a.out.stem}_tests"), tests, "Own lift against others [mm].")
