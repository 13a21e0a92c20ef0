"""Estimate fabrics by the physics-informed network: our recipe beside the paper's.

python experiments/pinn_recipes.py                                       # ours, five fabrics
python experiments/pinn_recipes.py --fabrics pink_solid --pulls 1 --methods ours paper --seeds 5

A sheet is pulled along the warp, the weft and the bias (or only the first of these). Printed for
each estimate: errors of the stiffnesses (relative; of the coupling absolute), with the standard
errors that ours gives, and CPU seconds with compilation. Estimates in OUT are not made again.
"""

import itertools
import math
import time

import jax
from _common import relative_errors
from _tables import Line, command_line, resumed

import r2s
from r2s.estimation.pinn import from_pulls, published_recipe
from r2s.estimation.pinn.data import pull_from, stacked
from r2s.estimation.pinn.synthetic_pulls import pulled
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace

ANGLES = (0.0, math.pi / 2, math.pi / 4)
START = (10.0, 0.0, 10.0, 10.0), 1e-5  # [N/m], [N m]: where the paper's recipe begins


def estimated(fabric: str, pulls: str, method: str, seed: str) -> Line:
    """Estimate one fabric from noisy pulls of it."""
    truth, began = presets.FIVE[fabric](), time.process_time()
    space, key = OrthotropicSpace.make(float(truth.density)), jax.random.key(int(seed))
    some = []
    for i, angle in enumerate(ANGLES[: int(pulls)]):
        noise = jax.random.fold_in(key, i)
        some.append(pull_from(pulled(truth, fabric, angle, shape=(33, 33), key=noise), angle))
    if method == "ours":
        found = from_pulls.estimate(some, space, key=key).estimate
        values, known = found.values, found.standard_errors
    else:
        start = space.locate(r2s.Fabric.make(float(truth.density), *START))
        trained = published_recipe.train(space, stacked(some), start, key=key).model
        values, known = space.values(trained.place), [math.nan] * space.dim
    errors = zip(space.ranges, relative_errors(space, truth, values), known, strict=True)
    line = {bound.name: f"{error:+.4f} ({spread:.4f})" for bound, error, spread in errors}
    return line | {"CPU s": f"{time.process_time() - began:.0f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/pinn_recipes.csv")
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE), choices=presets.FIVE)
    parser.add_argument("--pulls", default="3", choices=("1", "2", "3"))
    parser.add_argument("--methods", nargs="*", default=["ours"], choices=("ours", "paper"))
    parser.add_argument("--seeds", type=int, default=1)
    a = parser.parse_args()
    every = itertools.product(a.fabrics, [a.pulls], a.methods, map(str, range(a.seeds)))
    jobs = [dict(zip(("fabric", "pulls", "method", "seed"), each, strict=True)) for each in every]
    resumed(a.out, "errors of estimates from stretchings (standard errors)", jobs, estimated)
