"""Pulls of knits, fitted with yarns of constant stiffness and with yarns that stiffen.

python experiments/knits.py experimentData      # 3 minutes on one core

`experimentData` is that folder of stitch-by-stitch (`r2s.laboratory.knits` says how to get it). Of
each knit its pulls along wales and courses are fitted together; "off" is the root mean square over
samples of the force's error, over the largest force of a pull [%], and the mean over its pulls.
"""

import dataclasses
import math
from pathlib import Path

from _laboratory import off
from _tables import Line, command_line, keep

from r2s.estimation.default_spaces import on_cloth
from r2s.fabrics.parameters import Range
from r2s.fabrics.stiffening_space import StiffeningSpace
from r2s.laboratory.estimate import estimate
from r2s.laboratory.knits import read_knit

YARNS, STITCHES = ("Acrylic Yarn", "Pearlized Cotton"), ("Garter", "Rib", "Seed", "Stockinette")
DENSITY = 0.3  # [kg/m^2], assumed: pulls do not tell it
SOFTEST = 1.0  # [N/m]: knits are softer than the prior's fabrics


if __name__ == "__main__":
    parser = command_line(__doc__, "results/knits.csv")
    parser.add_argument("folder", type=Path)
    a = parser.parse_args()
    usual = on_cloth(DENSITY)
    yarns = tuple(Range(r.name, r.unit, SOFTEST, r.high) for r in usual.ranges[:2])
    linear = dataclasses.replace(usual, ranges=(*yarns, *usual.ranges[2:]))
    spaces = {"linear": linear, "stiffening": StiffeningSpace.make(linear)}
    lines: list[Line] = []
    for yarn in YARNS:
        for stitch in STITCHES:
            files = {"Y": 0.0, "X": math.pi / 2}
            pulls = {
                side: read_knit(a.folder / f"outputData_{yarn} {stitch} {side}.h5", angle)
                for side, angle in files.items()
            }
            row: dict[str, float] = {}
            for name, space in spaces.items():
                found = estimate([*pulls["Y"], *pulls["X"]], space)
                row |= {f"off wales, {name}": off(pulls["Y"], found.fabric)}
                row |= {f"off courses, {name}": off(pulls["X"], found.fabric)}
                if name == "stiffening":
                    values = dict(zip((r.name for r in space.ranges), found.values, strict=True))
                    row |= {f"{n} [N/m]": float(values[n]) for n in ("warp", "weft")}
                    row |= {n: float(values[n]) for n in ("coupling", "stiffening")}
                    row |= {n: float(values[n]) for n in ("knee warp", "knee weft")}
            lines.append({"knit": f"{yarn} {stitch}"} | {k: f"{v:.3g}" for k, v in row.items()})
            keep(a.out, lines, "Uniaxial pulls of knits (stitch-by-stitch), fitted.")
