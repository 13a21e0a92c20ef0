"""What estimates from real recordings predict of other recordings of the same fabric.

python experiments/real_recordings.py recordings --density 0.15      # two hours on one core
python experiments/real_recordings.py recordings --prior fabrics --lifts-alone    # one hour
python experiments/real_recordings.py swings --swings --density 0.2 --out results/swings.csv

An estimate from each lift predicts the fold that it has not seen. Errors [mm] are mean distances
both ways between a recording and what its cameras would have seen of a simulation: as read, and
"placed" where the recording lies nearest (at most 30 mm and 0.3 rad off), which leaves the cameras
out. Samples of the prior know the weight alone. Estimates are stored in the folder --kept, and not
made again. With --prior fabrics the prior is that of measured fabrics of the weight; --lifts-alone
leaves out estimates from the folds.

With --swings density and stiffness are estimated from four measured swings, which predict the
others: see `_swings.py` (15 minutes).
"""

from pathlib import Path

import jax
import numpy as np
from _real import beside, compared, errors, estimated, frames_of, recordings_in
from _swings import predict_swings
from _tables import command_line, keep

import r2s
from r2s.materials import prior
from r2s.recordings.recording import cloud

SAMPLES = 8  # of the prior


def predict_folds(options, space: r2s.ParameterSpace, samples: list[r2s.Fabric]) -> None:
    """Write the table of folds, and the tests of its columns against each other."""
    shape = tuple(options.shape)
    lifts, folds = (recordings_in(options.recordings, name) for name in ("lift", "fold"))
    learnt = lifts if options.lifts_alone else [*lifts, *folds]
    made = {r.info.name: (r.info, estimated(r, space, shape, options.kept)) for r in learnt}
    table: dict[str, dict[str, float]] = {}
    for fold in folds:
        info, frames = fold.info, frames_of(fold)
        real = [cloud(fold, frame) for frame in frames]
        moved = beside(fold, made.values(), samples, shape)
        again = [r for r in folds if r.info.fabric == info.fabric and r is not fold]
        moved["other trial"] = [[cloud(r, frame) for frame in frames] for r in again]
        row = {}
        for name in filter(moved.get, moved):
            row[name], row[f"{name}, placed"] = errors(real, moved[name])
        table[info.name] = row
        columns = dict.fromkeys(name for row in table.values() for name in row)
        means = {n: np.mean([row[n] for row in table.values() if n in row]) for n in columns}
        rows = [*table.items(), ("mean", means)]
        texts = {n: {k: f"{v:.1f}" for k, v in r.items()} for n, r in rows}
        lines = [{"recording": n} | {k: r.get(k, "-") for k in columns} for n, r in texts.items()]
        keep(options.out, lines, "Real folds, predicted from lifts: mean distance both ways [mm].")
    fabrics, tests = [fold.info.fabric for fold in folds], []
    for end in ("", ", placed"):
        for other in ("prior", "other fabrics' lifts", "other trial"):
            tests += compared(table, fabrics, f"own lift{end}", f"{other}{end}")
    if tests:
        path = options.out.with_stem(f"{options.out.stem}_tests")
        keep(path, tests, "Own lift against others [mm].")


if __name__ == "__main__":
    parser = command_line(__doc__, "results/real_recordings.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--swings", action="store_true", help="the folder has swings")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    parser.add_argument("--kept", type=Path, default=Path("results/real_estimates"))
    parser.add_argument("--shape", type=int, nargs=2, default=(9, 9), help="vertices")
    parser.add_argument("--prior", choices=("flat", "fabrics"), default="flat")
    parser.add_argument("--lifts-alone", action="store_true")
    a = parser.parse_args()
    space = r2s.OrthotropicSpace.make(a.density)
    samples = prior.fabrics(a.density, SAMPLES, jax.random.key(0))
    if a.swings:
        predict_swings(a.recordings, space, samples, a.out)
    else:
        if a.prior == "fabrics":
            space = prior.informed(space, a.density)
        predict_folds(a, space, samples)
