"""How well does each of the five fabrics move that was estimated from some of its recordings?

python experiments/skill_by_fabric.py --out docs/results/skill_by_fabric.csv    # two hours

By default from a lift and three pulls together. Errors are mean distances up to the horizon, beside
the floor of the truth, the true fabric at small strain, the middle of the prior and the mean of
draws of it (the default); skill is 1 at the floor and 0 at the default. Numbers of the fabrics are
over the truth's at small strain (coupling: the difference). Truths stiffen as they stretch and lose
up to 35 % of their bending stiffness, which estimates of constant stiffness (`--law linear`) cannot
follow; by default an estimate has the laws that its recordings tell.
"""

from functools import partial
from pathlib import Path

from _skills import predicted
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

TOGETHER = "diffcloud-cloth-lifting+stretching"
CAPTION = (
    "Mean distances [mm] up to the horizon, skill, and numbers of the estimate over the truth's "
    "at small strain (coupling: difference; *: the truth is outside its 90 % interval). Growth: by "
    "how much the energy of a 5 % stretch exceeds that of constant stiffness. Left out: points or "
    "markers of each recording that count as outliers."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/skill_by_fabric.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--configurations", nargs="+", default=[TOGETHER])
    parser.add_argument("--law", default="told", help="told by the recordings, or linear, ...")
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [
        {"configuration": configuration, "law": a.law, "fabric": fabric}
        for configuration in a.configurations
        for fabric in a.fabrics
    ]
    resumed(a.out, CAPTION, jobs, partial(predicted, a.folder))
