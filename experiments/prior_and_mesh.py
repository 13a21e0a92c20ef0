"""Do estimates on a coarse mesh predict better for knowing what fabrics are like?

python experiments/prior_and_mesh.py      # 40 minutes on one core

A lift of each of the five fabrics on 33 x 33 vertices, seen by two depth cameras, is estimated from
on 9 x 9: with no prior ("flat"), and with that of measured fabrics, which counts for more as far as
the mesh errs (`r2s.estimation.mesh_bias.weighed`). Predicted are three motions that the estimate
never saw, all of them on 17 x 17 vertices. Written is the mean distance of vertices from the true
fabric's on the same mesh [mm] (which is then zero), beside those of the prior's middle and of its
draws, which know the weight alone; and the estimate's errors in its own standard errors: the root
of their mean square, and the largest.
"""

import itertools

import jax
import numpy as np
from _predicted import predicted
from _tables import Line, command_line, resumed

from r2s import scenarios
from r2s.estimation.default_spaces import on_cloth
from r2s.estimation.diffcloud import DiffCloud
from r2s.fabrics import presets, prior
from r2s.scenarios import synthetic

FINE, COARSE = (33, 33), (9, 9)
PRIORS = ("fabrics", "flat")


def attempt(prior_of: str, fabric: str) -> Line:
    """Estimate from a fine lift, and predict."""
    truth, key = presets.FIVE[fabric](), jax.random.key(0)
    density = float(truth.density)
    lift = synthetic.record(scenarios.lifting(), truth, fabric, shape=FINE, key=key)
    space = on_cloth(density)
    space = space if prior_of == "flat" else prior.informed(space, density)
    method = DiffCloud(shape=COARSE)
    budget = method.budget._replace(coarse=16, starts=2, iterations=20)
    found = method.estimate([lift], space, budget, key=key)
    true_values = np.asarray(space.values(space.to_unit(truth)))
    rows = zip(space.ranges, found.values, true_values, strict=True)
    off = np.array([np.log(v / t) if r.log else v - t for r, v, t in rows])
    score = off / found.standard_errors
    line = {
        "errors, root mean square": f"{np.sqrt(np.mean(score**2)):.1f}",
        "largest": f"{np.max(np.abs(score)):.1f}",
    }
    return line | predicted(truth, fabric, found.fabric)


if __name__ == "__main__":
    a = command_line(__doc__, "results/prior_and_mesh.csv").parse_args()
    every = itertools.product(PRIORS, presets.FIVE)
    jobs: list[Line] = [{"prior_of": p, "fabric": name} for p, name in every]
    resumed(a.out, "Estimates from a lift on a coarse mesh: what they predict [mm].", jobs, attempt)
