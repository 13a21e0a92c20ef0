"""Run the six scenarios on both solvers with the softest and the stiffest preset, and check them.

python experiments/scenarios.py      # about 10 minutes on one core

Printed for each run: the lowest vertex above the table, the greatest stretch (mean of a frame; of a
sample farther than 10 cm from a gripper), the work of the grippers and what was dissipated in all,
and the least that was dissipated in one frame: negative where energy came from nowhere.
"""

import itertools

import equinox as eqx
import numpy as np
from _tables import Line, command_line, keep

from r2s import scenarios
from r2s.fabrics import presets
from r2s.scenarios.energy import EnergyBalance, stretch
from r2s.scenarios.scenario import Scenario

FABRICS = ("grey_interlock", "black_denim")  # softest and stiffest membrane of the five
SOLVERS = {"cloth": (13, 13), "touching": (9, 9), "points": (13, 13)}  # and vertices
GRIP = 0.1  # [m] around held vertices, where a sheet that hangs by a point has no bound
balance_of = eqx.filter_jit(scenarios.energy_balance)


def figures(scenario: Scenario, found: EnergyBalance) -> Line:
    """What has to hold of a motion, and its energies [mJ] from the first to the last frame."""
    mesh, held = scenario.scene.mesh, scenario.scene.held
    rest, stretched = np.asarray(mesh.rest), np.asarray(stretch(mesh, found.x))
    elements = rest[np.asarray(mesh.samples.corners)].mean(axis=1)[:, None] - rest[np.asarray(held)]
    apart = np.repeat(elements, mesh.samples.areas.shape[1], axis=0)
    far = np.linalg.norm(apart, axis=2).min(axis=1) > GRIP
    lowest = np.asarray(found.x)[..., 2].min() - float(scenario.scene.table.height)
    work, lost = 1e3 * np.asarray(found.grippers), 1e3 * np.asarray(found.dissipated)
    return {
        "lowest [mm]": f"{1e3 * lowest:.2f}",
        "mean stretch": f"{stretched.mean(axis=1).max():.1%}",
        "away from grippers": f"{stretched[:, far].max():.1%}",
        "grippers' work [mJ]": f"{work[-1] - work[0]:.2f}",
        "dissipated [mJ]": f"{lost[-1] - lost[0]:.2f}",
        "least in a frame [mJ]": f"{np.diff(lost).min():.3f}",
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "results/scenarios.csv")
    parser.add_argument("--only", nargs="*", default=list(scenarios.SIX), choices=scenarios.SIX)
    a = parser.parse_args()
    lines: list[Line] = []
    for name, kind, preset in itertools.product(a.only, SOLVERS, FABRICS):
        if kind == "touching" and name != "folding":
            continue  # in the others no self-contact is needed
        fabric = presets.FIVE[preset]()
        scenario = scenarios.SIX[name]().scenario(SOLVERS[kind], self_contact=kind == "touching")
        solver = scenarios.material_points(scenario, fabric) if kind == "points" else None
        found = balance_of(scenario, fabric, None, solver)
        lines.append({"scenario": name, "solver": kind, "fabric": preset})
        lines[-1] |= figures(scenario, found)
        keep(a.out, lines, "The six scenarios, by solver and fabric.")
