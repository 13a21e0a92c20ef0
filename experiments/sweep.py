"""Simulate a thousand fabrics, and print which parameter decides how a lifted sheet hangs.

python experiments/sweep.py --fabrics 1000 --out results/sweep      # a minute on one core

Fabrics are drawn evenly (on the scale of each range) from the whole parameter space. A chunk of
them is spread over all devices; chunks that are in OUT already are not simulated again. Printed:
Spearman's rank correlation of each parameter with the height [m] of the corner that hangs lowest
above the table after a lift, and with the mean height of the sheet.
"""

import jax
import jax.numpy as jnp
from _tables import command_line, keep
from scipy.stats import spearmanr

import r2s
from r2s import scenarios
from r2s.sweep import sweep


def heights(theta):
    """Height [m] at the end of a lift, of the mean vertex and of the farthest one from the grip."""
    x = r2s.rollout(SCENARIO, SPACE(theta)).x[-1, :, 2]
    return {"mean height": jnp.mean(x), "far corner": x[-1]}


SPACE = r2s.OrthotropicSpace.make(density=0.2)  # [kg/m^2]
SCENARIO = scenarios.lifting((0.3, 0.3), num_frames=20, moving=1.0).scenario((5, 5))

if __name__ == "__main__":
    parser = command_line(__doc__, "results/sweep")
    parser.add_argument("--fabrics", type=int, default=1000)
    parser.add_argument("--chunk", type=int, default=250)
    a = parser.parse_args()
    thetas = jax.random.uniform(jax.random.key(0), (a.fabrics, SPACE.dim), float)
    found = sweep(heights, thetas, a.chunk, folder=a.out / "chunks")
    lines = []
    for bound, column in zip(SPACE.ranges, thetas.T, strict=True):
        ranks = {name: f"{spearmanr(column, values)[0]:+.2f}" for name, values in found.items()}
        lines.append({"parameter": bound.name} | ranks)
    keep(a.out / "sweep.csv", lines, f"Rank correlation over {a.fabrics} fabrics, after a lift.")
