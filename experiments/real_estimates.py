"""What real recordings were estimated to be of, from the estimates that another driver kept.

python experiments/real_estimates.py results/real_estimates      # after real_recordings.py

Of each lift's estimate bending and shear stiffness, with standard errors in its logarithm, and how
much longer the sheet is than was written down.
"""

import json
import math
from pathlib import Path

from _real import size_of
from _tables import Line, command_line, keep

from r2s.estimation.estimate_json import from_json

SHOWN = ("bending", "shear")

if __name__ == "__main__":
    parser = command_line(__doc__, "results/real_lifts.csv")
    parser.add_argument("kept", type=Path, help="folder of estimates")
    a = parser.parse_args()
    lines: list[Line] = []
    for file in sorted(a.kept.glob("lift_*.json")):
        found = from_json(json.loads(file.read_text(encoding="utf-8")))
        line = {"lift": file.stem.partition(".")[0]}
        for bound, value, error in zip(
            found.ranges, found.values, found.standard_errors, strict=True
        ):
            if bound.name in SHOWN:
                line[f"{bound.name} [{bound.unit}]"] = f"{value:.2g} (factor {math.exp(error):.1f})"
        lines.append(line | {"size": f"{size_of(found):.3f}"})
    keep(a.out, lines, "Estimates from real lifts, on 9 x 9 vertices.")
