"""Estimate the fabric of every recording of a folder by PhysNet, on the map of a trained network.

python experiments/estimate_by_physnet.py recordings --scenario lifting --density 0.15

The network is trained once, on simulated motions of the scenario (20 minutes on one core), and kept
beside OUT; then each recording takes one search of 80 simulations. A recording says its scenario by
the names of r2s (lifting, wind, ...). PhysNet gives no standard errors: what it finds is to be
compared with other methods, or with itself from other seeds. Needs r2s[physnet].
"""

from pathlib import Path

import jax
from _common import recordings_in, values_of
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.physnet.method import PhysNetMethod

if __name__ == "__main__":
    parser = command_line(__doc__, "results/physnet.csv")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--scenario", default="lifting")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    space, key = r2s.OrthotropicSpace.make(a.density), jax.random.key(a.seed)
    method = PhysNetMethod(network=a.out.with_name(f"{a.scenario}.network"))
    lines: list[Line] = []
    for recording in recordings_in(a.recordings, a.scenario):
        found = method.estimate([recording], space, key=key)
        lines.append({"recording": recording.info.name} | values_of(found))
        keep(a.out, lines, f"Estimates by PhysNet from {a.scenario}.")
