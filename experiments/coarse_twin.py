"""Is there a fabric with which a coarse sheet moves as a fine one does with the true fabric?

python experiments/coarse_twin.py --out docs/results/coarse_twin.csv      # two hours

A sheet of 9 x 9 vertices is fitted to a lift of each fabric (or, in hours, to a lift and a fling),
with nothing known beforehand; what it fits is judged in a fling and a shaking that it has not seen,
on its own mesh and on a fine one, beside the true fabric at small strain on both, and draws of the
prior on its own. A simulator that can afford no finer mesh is best given the fabric whose error
is least.
"""

from functools import partial
from pathlib import Path

from _coarse_twin import FITTED_TO, line
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

CAPTION = (
    "Mean distances [mm] from the recorded points up to the horizon, on 9 x 9 vertices or "
    "(fine) on 33 x 33; warp, weft, shear, bending and damping of what was fitted over the truth's."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/coarse_twin.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--motions", nargs="+", default=["fling", "shaking"])
    parser.add_argument("--fitted-to", nargs="+", choices=FITTED_TO, default=["lift"])
    parser.add_argument("--folder", type=Path, default=Path("results/coarse_twin"), help="of cells")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"motion": motion, "fabric": fabric} for fabric in a.fabrics for motion in a.motions
    ]
    resumed(a.out, CAPTION, jobs, partial(line, a.folder, a.fitted_to))
