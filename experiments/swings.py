"""Estimate density and stiffness from a few measured swings, and predict all the others.

python experiments/swings.py swings      # 15 minutes on one core

Errors [mm] are mean distances from the tracked points to where they are predicted, over the first
seconds of each swing. The tracker's own error is that of the row which the bar holds, whose place
is known. The prior's draws know nothing but a usual weight. "placed": with the place of the
tracker's frame as the swings learnt from tell it, the same for all that is compared.
"""

from pathlib import Path

import jax
import numpy as np
from _swings import errors, estimated, facts, learnt_offset, swings
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.estimate import describe
from r2s.fabrics import prior

LEARNT = ("range030_rep01", "range060_rep04", "range090_rep02", "range120_rep01")
DRAWS = 8
CAPTION = "Swings predicted from four others: mean distances [mm]."

if __name__ == "__main__":
    parser = command_line(__doc__, "results/swings.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--density", type=float, default=0.2, help="usual areal density [kg/m^2]")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each swing")
    a = parser.parse_args()
    space = r2s.OrthotropicSpace.make(a.density)
    found = estimated(swings(a.recordings, LEARNT, a.seconds), space)
    print("\n".join(describe(found)), f"density {float(found.fabric.density):.3g} kg/m^2", sep="\n")
    offset = learnt_offset(found)
    told = facts(found)
    draws = prior.fabrics(a.density, DRAWS, jax.random.key(0))
    lines: list[Line] = []
    rows: list[dict[str, float]] = []
    for swing in swings(a.recordings, (), a.seconds):
        if swing.info.name in LEARNT:
            continue
        of = {"estimate": [found.fabric], "default": [space.middle()], "prior": draws}
        row: dict[str, float] = {}
        made = {
            name: np.array([errors(swing, fabric, offset) for fabric in fabrics])
            for name, fabrics in of.items()
        }
        for place, how in enumerate(("", " placed")):
            row["tracker" + how] = 1e3 * float(made["default"][0, place, 0])
            for name, each in made.items():
                row[name + how] = 1e3 * float(np.nanmean(each[:, place]))
            row["estimate / tracker" + how] = row["estimate" + how] / row["tracker" + how]
        row["diverged"] = float(sum(np.isnan(each[:, 0, 0]).sum() for each in made.values()))
        rows.append(row)
        lines.append({"swing": swing.info.name} | {n: f"{v:.2f}" for n, v in row.items()})
        means = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
        last = {"swing": "mean"} | {name: f"{value:.2f}" for name, value in means.items()}
        keep(a.out, [*lines, last], CAPTION, told)
