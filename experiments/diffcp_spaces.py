"""What does DiffCP gain by damping, friction and orthotropy as parameters?

python experiments/diffcp_spaces.py --out docs/results/diffcp_spaces.csv      # an hour

A lift of each fabric is estimated on material points, with what is known of fabrics of its weight
beforehand: as an isotropic sheet whose damping and friction are those of the prior, with both as
parameters, and as an orthotropic sheet. What it finds is judged in a fling and a shaking, on points
and on the cloth, beside the true fabric at small strain.
"""

from pathlib import Path

from _diffcp_spaces import SPACES, line
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

CAPTION = (
    "Mean distances [mm] from the recorded points up to the horizon: what was found predicts on 9 "
    "x 9 material points and on the cloth of 33 x 33, beside the true fabric on both."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/diffcp_spaces.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--spaces", nargs="+", choices=SPACES, default=list(SPACES))
    parser.add_argument("--folder", type=Path, default=Path("results/diffcp"), help="of recordings")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"fabric": fabric, "space": space} for fabric in a.fabrics for space in a.spaces
    ]
    resumed(a.out, CAPTION, jobs, lambda **job: line(a.folder, **job))
