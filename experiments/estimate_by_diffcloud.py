"""Estimate every fabric of a folder by DIFFCLOUD: Gauss-Newton descents through the cloth.

python experiments/estimate_by_diffcloud.py recordings --scenario lift --density 0.15

All recordings of a fabric count together. Printed for each fabric: its parameters with standard
errors, those that the recordings do not determine in brackets, and whether the descents converged.
A fabric that was interrupted goes on where it was. `r2s estimate` writes a card of one fabric.
"""

from pathlib import Path

import jax
from _common import by_fabric, recordings_in, values_of
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.diffcloud import DiffCloud

if __name__ == "__main__":
    parser = command_line(__doc__, "results/diffcloud.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--scenario", default="lift")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    space, key = r2s.OrthotropicSpace.make(a.density), jax.random.key(0)
    lines: list[Line] = []
    for fabric, recordings in by_fabric(recordings_in(a.recordings, a.scenario)).items():
        method = DiffCloud(checkpoint=a.out.with_name(f"{fabric}.diffcloud.npz"))
        found = method.estimate(recordings, space, key=key)
        lines.append({"fabric": fabric} | values_of(found))
        keep(a.out, lines, f"Estimates by DIFFCLOUD from {a.scenario}, with standard errors.")
