"""Do the intervals of 90 % hold the truth? Noisy recordings of the five presets, and estimates.

python experiments/coverage.py --scenario lifting --each 10      # about 10 minutes on one core

Every estimate begins at the truth, so that the intervals are judged and not the search. Prints, for
each parameter, how often the interval holds the truth, and the spread of errors over standard
errors. Estimates that are in OUT already are not made again.
"""

import jax
import numpy as np
from _common import relative_errors, synthetic_problem
from _tables import Line, command_line, keep, resumed

from r2s.estimation.descent import DEFAULT
from r2s.estimation.judgement import descend
from r2s.fabrics import presets

NINETY = 1.645  # standard errors to either side


def scores(scenario: str, fabric: str, seed: str) -> Line:
    """Estimate one recording: its errors, in its own standard errors."""
    truth, space, problem = synthetic_problem(fabric, scenario, 1000 + int(seed))
    budget = DEFAULT._replace(coarse=0, starts=1)
    start, key = space.to_unit(truth), jax.random.key(0)
    found = descend(problem, budget, start=start, key=key)
    score = relative_errors(space, truth, found.values) / found.standard_errors
    return {bound.name: f"{z:.3f}" for bound, z in zip(space.ranges, score, strict=True)}


def summary(lines: list[Line]) -> list[Line]:
    """One line for each parameter, and one for all."""
    names = list(lines[0])[3:]
    z = np.array([[float(line[name]) for name in names] for line in lines])
    columns = zip([*names, "all"], [*z.T, z.ravel()], strict=True)
    held = [(name, np.mean(np.abs(column) < NINETY), column.std()) for name, column in columns]
    return [{"parameter": n, "held": f"{h:.0%}", "spread": f"{s:.2f}"} for n, h, s in held]


if __name__ == "__main__":
    parser = command_line(__doc__, "results/coverage")
    parser.add_argument("--scenario", default="lifting", choices=("lifting", "wind", "stretching"))
    parser.add_argument("--each", type=int, default=10, help="recordings of each preset")
    a = parser.parse_args()
    named = [(name, str(i)) for name in presets.FIVE for i in range(a.each)]
    jobs = [{"scenario": a.scenario, "fabric": name, "seed": i} for name, i in named]
    lines = resumed(a.out / f"{a.scenario}.csv", "Errors over standard errors.", jobs, scores)
    keep(
        a.out / f"{a.scenario}_summary.csv",
        summary(lines),
        "How often the interval of 90 % holds the truth.",
    )
