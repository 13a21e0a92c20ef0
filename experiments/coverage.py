"""How often do intervals of 90 % hold the truth? Repeated estimates of known fabrics.

python experiments/coverage.py --repeats 1 2 3 --out docs/results/repeats.csv       # four hours

Each repeat has recordings of its own, a lift and three pulls as in the study (finer meshes, other
laws), and its own start of the search. The table has errors over standard errors, in brackets what
is not narrowed to half; a second one, beside it, how often the intervals of each parameter hold the
truth.
"""

from functools import partial
from pathlib import Path

import numpy as np
from _skills import repeated
from _tables import Line, command_line, keep, resumed
from scipy.stats import norm

from r2s.materials import presets

TOGETHER = "diffcloud-cloth-lifting+stretching"
CAPTION = (
    "Errors over standard errors of estimates from a lift and three pulls; in brackets what is not "
    "narrowed to half of the prior, and by how much the rest is off at most (a share of the truth; "
    "of the coupling the difference)."
)
SUMMARY = (
    "Of these estimates: how many 90 % intervals hold the truth, how often a parameter is called "
    "narrowed, how many of these intervals hold it, and the largest error then, in standard "
    "errors."
)
OTHERS = ("fabric", "repeat", "narrowed off at most", "converged", "recordings agree")
DIVERGED = "(inf)"  # what is no estimate holds no truth


def by_parameter(lines: list[Line]) -> list[Line]:
    """One line for each parameter, and one for all; none where all estimates diverged."""
    names = list(dict.fromkeys(name for line in lines for name in line if name not in OTHERS))
    if not any(line.get(name) for line in lines for name in names):
        return []
    cells = np.array([[line.get(name) or DIVERGED for name in names] for line in lines])
    known = ~np.char.startswith(cells, "(")
    away = np.abs(np.char.strip(cells, "()").astype(float))
    every = zip([*names, "all"], [*away.T, away.ravel()], [*known.T, known.ravel()], strict=True)
    return [{"parameter": name} | _held(errors, which) for name, errors, which in every]


def _held(errors: np.ndarray, known: np.ndarray) -> Line:
    inside = errors < norm.ppf(0.95)
    return {
        "held": f"{inside.sum()} of {len(inside)}",
        "narrowed": f"{known.sum()}",
        "held of these": f"{inside[known].sum()}" if known.any() else "-",
        "errors off at most": f"{errors[known].max():.1f}" if known.any() else "-",
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/repeats.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--repeats", nargs="+", default=["1", "2", "3"], help="their numbers")
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [{"fabric": f, "repeat": r} for r in a.repeats for f in a.fabrics]
    lines = resumed(a.out, CAPTION, jobs, partial(repeated, a.folder, TOGETHER))
    keep(a.out.with_name(f"{a.out.stem}_by_parameter.csv"), by_parameter(lines), SUMMARY)
