"""How often do intervals of 90 % hold the truth? Repeated estimates of known fabrics.

python experiments/coverage.py --repeats 1 2 3 --out docs/results/repeats.csv       # four hours
python experiments/coverage.py --same-model lifting --out results/same_model.csv    # 10 minutes

Each repeat has recordings of its own, a lift and three pulls as in the study (finer meshes, other
laws), and its own start of the search. With --same-model the recordings come from the estimator's
own mesh and laws, and each estimate begins at the truth: the intervals are judged, not the search.
The table has errors over standard errors, in brackets what is not narrowed to half; a second
one, beside it, how often the intervals of each parameter hold the truth.
"""

from functools import partial
from pathlib import Path

import jax
import numpy as np
from _skills import NARROWED, repeated
from _tables import Line, command_line, keep, resumed
from scipy.stats import norm

from r2s import scenarios
from r2s.estimation.descent import DEFAULT
from r2s.estimation.judgement import descend
from r2s.estimation.problem import Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

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


def by_same_model(scenario: str, fabric: str, repeat: str) -> Line:
    """Errors over standard errors of an estimate that begins at the truth."""
    truth, seed = presets.FIVE[fabric](), 1000 + int(repeat)
    experiment = scenarios.SCENARIOS[scenario]()
    recording = synthetic.record(experiment, truth, fabric, key=jax.random.key(seed))
    space = OrthotropicSpace.make(float(truth.density))
    problem = Problem.make(recording, space, seed=seed)
    budget, start = DEFAULT._replace(num_samples=0, num_starts=1), space.to_unit(truth)
    estimate = descend(problem, budget, start=start, key=jax.random.key(0))
    true = np.asarray(space.values(start))
    relative = np.where([bound.log for bound in space.ranges], true, 1.0)
    errors = (np.asarray(estimate.values) - true) / relative / estimate.standard_errors
    named = zip(space.ranges, errors, estimate.narrowing < NARROWED, strict=True)
    return {bound.name: f"{z:+.2f}" if known else f"({z:+.2f})" for bound, z, known in named}


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/repeats.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--repeats", nargs="+", default=["1", "2", "3"], help="their numbers")
    parser.add_argument("--same-model", choices=("lifting", "wind", "stretching"))
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [{"fabric": f, "repeat": r} for r in a.repeats for f in a.fabrics]
    caption, make = CAPTION, partial(repeated, a.folder, TOGETHER)
    if a.same_model:
        caption = "Errors over standard errors, by the recordings' own model."
        make = partial(by_same_model, a.same_model)
    lines = resumed(a.out, caption, jobs, make)
    keep(a.out.with_name(f"{a.out.stem}_by_parameter.csv"), by_parameter(lines), SUMMARY)
