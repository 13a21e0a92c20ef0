"""Estimate every fabric of a folder by one of the approaches.

python experiments/estimate.py recordings --method diffcloud --scenario lift --density 0.15
python experiments/estimate.py recordings --method pinn --scenario stretching

DIFFCLOUD, DiffCP (an isotropic sheet of material points) and the PINN take all recordings of a
fabric together, PhysNet takes each alone. PhysNet's network is trained once (20 minutes on one
core) in the folder OUT; it needs a scenario of r2s (lifting, wind, ...) and r2s[physnet]. Printed
are the parameters with standard errors (PhysNet has none); OUT has the estimates as JSON. An
interrupted estimate of DIFFCLOUD or DiffCP continues. `r2s estimate` writes a card of one fabric.
"""

from pathlib import Path
from typing import Any

import jax
from _real import recordings_in
from _tables import command_line

import r2s
from r2s._util.files import write_json
from r2s.estimation.estimate import as_json
from r2s.estimation.method import Method
from r2s.estimation.summary import describe

METHODS = ("diffcloud", "diffcp", "physnet", "pinn")
DIFFCP_SHAPE = (7, 7)  # vertices of the sheet of material points


def method_named(name: str, group: str, scenario: str, folder: Path) -> Method:
    """The approach, with its files in a folder."""
    settings: dict[str, Any] = {"shape": DIFFCP_SHAPE} if name == "diffcp" else {}
    if name == "physnet":
        settings["network"] = folder / f"{scenario}.network"
    if name in ("diffcloud", "diffcp"):
        settings["checkpoint"] = folder / f"{group}.{name}.npz"
    return r2s.METHODS[name](**settings)


if __name__ == "__main__":
    parser = command_line(__doc__, "results/estimates")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--method", choices=METHODS, default="diffcloud")
    parser.add_argument("--scenario", default="lift")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    groups: dict[str, list[r2s.Recording]] = {}
    for recording in recordings_in(a.recordings, a.scenario):
        group = recording.info.name if a.method == "physnet" else recording.info.fabric
        groups.setdefault(group, []).append(recording)
    spaces = r2s.IsotropicSpace if a.method == "diffcp" else r2s.OrthotropicSpace
    space, key = spaces.make(a.density), jax.random.key(a.seed)
    a.out.mkdir(parents=True, exist_ok=True)
    for group, recordings in groups.items():
        method = method_named(a.method, group, a.scenario, a.out)
        estimate = method.estimate(recordings, space, key=key)
        write_json(a.out / f"{group}.{a.method}.json", as_json(estimate))
        print(group, *describe(estimate), sep="\n", flush=True)
