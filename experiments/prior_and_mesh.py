"""Do estimates predict better for knowing what fabrics are like, and for a finer mesh?

python experiments/prior_and_mesh.py                      # 40 minutes on one core
python experiments/prior_and_mesh.py --meshes finest --priors fabrics   # half an hour

A lift of each of the five fabrics on 33 x 33 vertices, seen by two depth cameras, is estimated from
on 9 x 9 vertices, or on the finest mesh: with no prior ("flat"), and with that of measured fabrics.
Predicted are three motions that the estimate never saw, all of them on 17 x 17 vertices. Written is
the mean distance of vertices from the true fabric's on the same mesh [mm] (which is then zero),
beside those of the prior's middle and of its draws, which know the weight alone; and each parameter
over the truth (of the coupling the difference) with its standard error, in brackets where it is not
called identifiable.
"""

import itertools

import jax
from _common import fitted_to_truth
from _predicted import predicted
from _tables import Line, command_line, resumed

from r2s import scenarios
from r2s.estimation.default_spaces import on_cloth
from r2s.estimation.diffcloud import DiffCloud
from r2s.fabrics import presets, prior
from r2s.scenarios import synthetic

FINE = (33, 33)
PRIORS = ("fabrics", "flat")
FEWER = DiffCloud.budget._replace(coarse=16, starts=2, iterations=20)
METHODS = {
    "coarse": (DiffCloud(shape=(9, 9)), FEWER),
    "finest": (DiffCloud(finest=True), DiffCloud.budget),
}


def attempt(prior_of: str, mesh: str, fabric: str) -> Line:
    """Estimate from a fine lift, and predict."""
    truth, key = presets.FIVE[fabric](), jax.random.key(0)
    density = float(truth.density)
    lift = synthetic.record(scenarios.lifting(), truth, fabric, shape=FINE, key=key)
    space = on_cloth(density)
    space = space if prior_of == "flat" else prior.informed(space, density)
    method, budget = METHODS[mesh]
    found = method.estimate([lift], space, budget, key=key)
    fitted = fitted_to_truth(space, truth, found)
    fitted = {name: text for name, text in fitted.items() if not name.startswith("mesh")}
    return fitted | predicted(truth, fabric, found.fabric)


if __name__ == "__main__":
    parser = command_line(__doc__, "results/prior_and_mesh.csv")
    parser.add_argument("--priors", nargs="*", choices=PRIORS, default=PRIORS)
    parser.add_argument("--meshes", nargs="*", choices=METHODS, default=["coarse"])
    a = parser.parse_args()
    every = itertools.product(a.priors, a.meshes, presets.FIVE)
    jobs: list[Line] = [{"prior_of": p, "mesh": mesh, "fabric": name} for p, mesh, name in every]
    resumed(a.out, "Estimates from a lift of a fine sheet: what they predict [mm].", jobs, attempt)
