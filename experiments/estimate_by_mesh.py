"""What does an estimate owe to its mesh? Recordings of fine sheets, fitted with coarser ones.

python experiments/estimate_by_mesh.py --fabrics grey_interlock --shapes 9    # 10 minutes
python experiments/estimate_by_mesh.py                                        # two days

A truth is a preset on 33 x 33 vertices, seen by two depth cameras; laws and steps are those of the
estimator. The mesh of "rule" is the one that the estimator chooses. Written for each parameter:
estimate over truth (of the coupling the difference) with its standard error, in brackets where it
is not called identifiable, and what the mesh has in that error. Then the root of the loss, beside
those of the true fabric and of the default fabric on the same mesh, and of the true fabric on its
own mesh: the floor.
"""

import itertools
import time

import jax
from _common import fitted_to_truth, loss_of
from _tables import Line, command_line, resumed

from r2s import scenarios
from r2s.estimation.diffcloud import DiffCloud
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

FINE = 33  # vertices a side
RULE = "rule"


def attempt(scenario: str, fabric: str, shape: str) -> Line:
    """Estimate from a recording of the fine sheet on a mesh of some vertices a side, or by rule."""
    truth, key = presets.FIVE[fabric](), jax.random.key(0)
    fine = synthetic.record(scenarios.SIX[scenario](), truth, fabric, shape=(FINE, FINE), key=key)
    space, began = OrthotropicSpace.make(float(truth.density)), time.process_time()
    method = DiffCloud(shape=None if shape == RULE else (int(shape), int(shape)))
    budget = method.budget._replace(coarse=16, starts=2, iterations=20)
    found = method.estimate([fine], space, budget, key=key)
    seconds = time.process_time() - began
    assert found.shape is not None
    losses = {
        "root of loss [mm]": found.loss,
        "of the truth [mm]": loss_of(fine, space, truth, found.shape),
        "of the default [mm]": loss_of(fine, space, space.middle(), found.shape),
        "floor [mm]": loss_of(fine, space, truth, (FINE, FINE)),
    }
    roots = {name: f"{1e3 * loss**0.5:.2f}" for name, loss in losses.items()}
    mesh = {"mesh": f"{found.shape[0]} x {found.shape[1]}"}
    return mesh | fitted_to_truth(space, truth, found) | roots | {"CPU s": f"{seconds:.0f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/estimate_by_mesh.csv")
    parser.add_argument("--scenarios", nargs="*", default=["lifting", "wind"])
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE), choices=presets.FIVE)
    parser.add_argument("--shapes", nargs="*", default=["9", "17", "33", RULE])
    a = parser.parse_args()
    every = itertools.product(a.shapes, a.scenarios, a.fabrics)
    jobs: list[Line] = [{"scenario": s, "fabric": f, "shape": n} for n, s, f in every]
    resumed(a.out, "Estimates from a fine sheet's recording, over the truth.", jobs, attempt)
