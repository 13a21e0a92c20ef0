"""Estimate every fabric of a folder by DiffCP: Gauss-Newton descents through material points.

python experiments/estimate_by_diffcp.py recordings --scenario lift --density 0.15

The sheet is isotropic: E h [N/m] and Poisson's ratio are estimated, from all recordings of a fabric
together. Printed for each fabric: both with standard errors, in brackets where the recordings do
not determine them, and whether the descents converged. The explicit steps take minutes a fabric.
"""

from pathlib import Path

import jax
from _common import by_fabric, recordings_in, values_of
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.diffcp import DiffCP

SHAPE = (7, 7)  # vertices of the sheet

if __name__ == "__main__":
    parser = command_line(__doc__, "results/diffcp.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--scenario", default="lift")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    space, key = r2s.IsotropicSpace.make(a.density), jax.random.key(0)
    lines: list[Line] = []
    for fabric, recordings in by_fabric(recordings_in(a.recordings, a.scenario)).items():
        checkpoint = a.out.with_name(f"{fabric}.diffcp.npz")
        method = DiffCP(shape=SHAPE, checkpoint=checkpoint)
        found = method.estimate(recordings, space, key=key)
        lines.append({"fabric": fabric} | values_of(found))
        keep(a.out, lines, f"Estimates by DiffCP from {a.scenario}, with standard errors.")
