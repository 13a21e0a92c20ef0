"""Estimate every fabric of a folder by the physics-informed network, from its stretchings.

python experiments/estimate_by_pinn.py recordings --density 0.15

The recordings have markers and the force on the clamp, and say at which angle to the warp they are
pulled. All pulls of a fabric count together. Printed for each fabric: its parameters with standard
errors, in brackets those that the pulls do not determine.
"""

from pathlib import Path

import jax
from _common import by_fabric, recordings_in, values_of
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.pinn.method import PINN

if __name__ == "__main__":
    parser = command_line(__doc__, "results/pinn.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    space, key = r2s.OrthotropicSpace.make(a.density), jax.random.key(0)
    method = PINN()
    lines: list[Line] = []
    for fabric, recordings in by_fabric(recordings_in(a.recordings, "stretching")).items():
        found = method.estimate(recordings, space, key=key)
        lines.append({"fabric": fabric} | values_of(found))
        keep(a.out, lines, "Estimates by the physics-informed network, with standard errors.")
