"""How well is each judged motion known, and does the true fabric beat knowing nothing in it?

python experiments/floors.py --out docs/results/floors.csv      # hours for five fabrics

For every preset and motion: the floor of the truth's ensemble and its horizon; what fabrics differ
by; the mean error up to the horizon of the true fabric at small strain (what a perfect estimate
would reach), and of the draws of the prior that are a study's default, with their range. All errors
are distances from the truth's points to the surface of the cloth that a study predicts with.
"""

from pathlib import Path

from _floors import line
from _tables import Line, command_line, resumed

from r2s.fabrics import presets
from r2s.study.configuration import MOTIONS

CAPTION = (
    "Mean distances [mm] up to the horizon: floor of the truth, true fabric at small strain, "
    "default (mean of draws of the prior, least to most). What fabrics differ by, and the causes "
    "of the floor: over the whole motion."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/floors.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--numbers", nargs="+", default=["0"], help="of the motions")
    parser.add_argument("--folder", type=Path, default=Path("results/floors"), help="of cells")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"motion": motion, "fabric": fabric, "number": number}
        for fabric in a.fabrics
        for motion in a.motions
        for number in a.numbers
    ]
    resumed(a.out, CAPTION, jobs, lambda **job: line(a.folder, **job))
