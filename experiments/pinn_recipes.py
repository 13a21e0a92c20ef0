"""Estimate fabrics by the physics-informed network: our recipe beside the paper's.

python experiments/pinn_recipes.py                                       # ours, five fabrics
python experiments/pinn_recipes.py --fabrics pink_solid --pulls 1 --methods pinn pinn-published

A sheet is pulled along the warp, the weft and the bias (or only the first of these). Printed for
each estimate: errors of the parameters (relative; of the coupling and friction absolute), in
brackets the standard errors where the method gives them, and CPU seconds with compilation.
Estimates that are in OUT are not made again.
"""

import itertools
import math
import time

import jax
from _common import relative_errors
from _tables import Line, command_line, resumed

import r2s
from r2s.estimation.pinn.method import PINN, PublishedPINN
from r2s.estimation.pinn.synthetic_pulls import pulled
from r2s.fabrics import presets

METHODS = {"pinn": PINN, "pinn-published": PublishedPINN}
ANGLES = (0.0, 90.0, 45.0)  # [degrees], from the pull to the warp
SHAPE = (33, 33)  # vertices of the sheet that is pulled


def estimated(fabric: str, pulls: str, method: str, seed: str) -> Line:
    """Estimate one fabric from noisy pulls of it."""
    truth, angles, key = presets.FIVE[fabric](), ANGLES[: int(pulls)], jax.random.key(int(seed))
    space = r2s.OrthotropicSpace.make(float(truth.density))
    recordings = [
        pulled(truth, fabric, math.radians(angle), shape=SHAPE, key=jax.random.fold_in(key, i))
        for i, angle in enumerate(angles)
    ]
    began = time.process_time()
    found = METHODS[method]().estimate(recordings, space, key=key)
    seconds = time.process_time() - began
    errors = relative_errors(space, truth, found.values)
    numbers = zip(space.ranges, errors, found.standard_errors, strict=True)
    line = {bound.name: f"{error:+.4f} ({spread:.4f})" for bound, error, spread in numbers}
    return line | {"CPU s": f"{seconds:.0f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/pinn_recipes.csv")
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE), choices=presets.FIVE)
    parser.add_argument("--pulls", default="3", choices=("1", "2", "3"))
    parser.add_argument("--methods", nargs="*", default=["pinn"], choices=METHODS)
    parser.add_argument("--seeds", type=int, default=1)
    a = parser.parse_args()
    every = itertools.product(a.fabrics, [a.pulls], a.methods, map(str, range(a.seeds)))
    jobs: list[Line] = [
        dict(zip(("fabric", "pulls", "method", "seed"), each, strict=True)) for each in every
    ]
    resumed(a.out, "Errors of estimates from stretchings (standard errors).", jobs, estimated)
