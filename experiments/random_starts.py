"""How often does an estimate arrive, from anywhere in the range? Ours, the recipe and CMA-ES.

python experiments/random_starts.py --starts 20 --out results/random_starts.csv   # hours, one core
python experiments/random_starts.py --fabrics grey_interlock --starts 2 --methods diffcloud

A fabric has one synthetic recording, and every start is a random place of the parameter space. A
run arrives when every parameter that the recording determines (according to a descent that begins
at the truth) is within 5 % of the truth. Runs that are in the file already are not made again.
"""

import itertools
import time

import jax
import numpy as np
from _common import relative_errors, synthetic_problem
from _tables import Line, command_line, resumed

from r2s.estimation import cma_es
from r2s.estimation.descent import DEFAULT
from r2s.estimation.diffcloud import published_recipe
from r2s.estimation.judgement import descend
from r2s.fabrics import presets

METHODS = {
    "diffcloud": descend,
    "diffcloud-published": lambda problem, start, key: published_recipe(problem, None, start=start),
    "cma-es": cma_es.search,
}


def attempt(scenario: str, fabric: str, method: str, seed: str) -> Line:
    """Estimate once from a random start: worst error, and CPU seconds with compilation."""
    truth, space, problem = synthetic_problem(fabric, scenario)
    only = DEFAULT._replace(coarse=0, starts=1)
    known = descend(problem, only, start=space.to_unit(truth), key=jax.random.key(0))
    key = jax.random.key(100 + int(seed))
    began, start = time.process_time(), jax.random.uniform(key, (space.dim,), float)
    found = METHODS[method](problem, start=start, key=key)
    seconds = time.process_time() - began
    errors = np.abs(relative_errors(space, truth, found.values))[known.identifiable]
    worst = max(errors, default=0.0)
    arrived = "yes" if worst <= 0.05 else "no"
    return {"arrived": arrived, "worst error": f"{worst:.3f}", "CPU s": f"{seconds:.0f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/random_starts.csv")
    parser.add_argument("--scenario", default="lifting", choices=("lifting", "wind", "stretching"))
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE))
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    parser.add_argument("--starts", type=int, default=20)
    a = parser.parse_args()
    every = itertools.product([a.scenario], a.fabrics, a.methods, map(str, range(a.starts)))
    names = "scenario", "fabric", "method", "seed"
    jobs: list[Line] = [dict(zip(names, each, strict=True)) for each in every]
    resumed(a.out, "Estimates from random starts.", jobs, attempt)
