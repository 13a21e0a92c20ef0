"""Do estimates of one fabric, each from other recordings of it, hold what they say?

python experiments/repeats.py --repeats 1 2 3 --out docs/results/repeats.csv       # four hours

Each is from a lift and three pulls of its own and begins at places of its own. Written are errors
over standard errors, in brackets of what is not called identifiable, and in a second table, beside
the first, for each parameter how often intervals of 90 % hold the truth.
"""

from functools import partial
from pathlib import Path

from _repeats import by_parameter
from _skills import repeated
from _tables import Line, command_line, keep, resumed

from r2s.fabrics import presets

TOGETHER = "diffcloud-cloth-lifting+stretching"
CAPTION = (
    "Errors over standard errors of estimates from a lift and three pulls; in brackets what is not "
    "called identifiable, and by how much the rest is off at most (a share of the truth; of the "
    "coupling the difference)."
)
SUMMARY = (
    "Of these estimates: how many 90 % intervals hold the truth, how often a parameter is called "
    "identifiable, how many of these intervals hold it, and the largest error then, in standard "
    "errors."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/repeats.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--repeats", nargs="+", default=["1", "2", "3"], help="their numbers")
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [{"fabric": f, "repeat": r} for r in a.repeats for f in a.fabrics]
    lines = resumed(a.out, CAPTION, jobs, partial(repeated, a.folder, TOGETHER))
    keep(a.out.with_name(f"{a.out.stem}_by_parameter.csv"), by_parameter(lines), SUMMARY)
