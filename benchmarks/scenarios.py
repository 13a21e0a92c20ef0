"""The six scenarios on both solvers, for the softest and the stiffest preset: figures and pictures.

python benchmarks/scenarios.py --out results/scenarios        # about 10 minutes on one core

Prints, and writes to `scenarios.csv` and `report.html`, of every run: whether it is finite, how
near it comes to the table, how far its faces are stretched, and where the energy went since the
first frame. Draws one picture a scenario: six frames of every run.
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import measure
import numpy as np
from scenario_pictures import picture

from r2s import scenarios
from r2s.fabrics import presets
from r2s.files import write_text
from r2s.scenarios.energy import EnergyBalance, stretch
from r2s.scenarios.scenario import Scenario
from r2s.study.report.page import Section, write_report
from r2s.study.statistics.tables import Table, csv_text

FABRICS = ("grey_interlock", "black_denim")  # softest and stiffest membrane of the five
SOLVERS = {"cloth": (13, 13), "layers": (9, 9), "points": (13, 13)}  # vertices of their meshes
COLOURS = {"cloth": "#4c8bc0", "layers": "#3c9c79", "points": "#d08a3e"}
GRIP = 0.1  # [m] around held vertices, where a sheet that hangs by a point has no bound
FINE = 4  # as many steps, to see what of the account of the cloth is an error of its steps
INTRO = """Each scenario with its default path, by both solvers: cloth, cloth whose layers touch
(folding alone), and material points; with the softest and the stiffest membrane of the five
presets. A sheet of 0.45 m.

Bars: every position is finite; no vertex is below the table (contact begins a thickness above it,
so its bound is that a vertex may be that much lower); away from the grippers denim is stretched by
less than 5 %. The interlock is a knit of 10 N/m: it stretches under its own weight.

Stretch is the greatest principal stretch less one of a face: the greatest mean over the faces of a
frame, the greatest of faces farther than 10 cm from a gripper, and of all; and the greatest share
of the area that is above 5 % in a frame. A gripper that holds one vertex is a point load, around
which the stretch has no bound as the mesh is refined.

Folding: cloth without layers passes through itself, and layers of material points lie about a
spacing of the grid (35 mm) above each other, as their potential energy shows.

Energies [mJ] are from the first to the last frame. Least dissipated in a frame: negative where
energy came from nowhere; beside it the same for the cloth with a quarter of the step."""

_account = eqx.filter_jit(scenarios.energy_balance)


def run(name: str, kind: str, fabric_name: str) -> tuple[Scenario, EnergyBalance, measure.Row]:
    """A scenario by a solver with a preset, and the row of its figures."""
    fabric = presets.FIVE[fabric_name]()
    scenario = scenarios.SIX[name]().scenario(SOLVERS[kind], self_contact=kind == "layers")
    solver = scenarios.material_points(scenario, fabric) if kind == "points" else None
    before = time.perf_counter()
    found: EnergyBalance = jax.block_until_ready(_account(scenario, fabric, None, solver))
    seconds = time.perf_counter() - before
    row = {"scenario": name, "solver": kind, "fabric": fabric_name, "seconds": seconds}
    row |= figures_of(scenario, found, float(fabric.thickness))
    if kind == "cloth":
        step = scenario.interval / (FINE * scenario.substeps)
        finer: EnergyBalance = _account(scenario, fabric, step)
        row["least_fine_mj"] = 1e3 * float(np.diff(np.asarray(finer.dissipated)).min())
    return scenario, found, row


def figures_of(scenario: Scenario, found: EnergyBalance, thickness: float) -> measure.Row:
    """What has to hold of a motion, and its energy account from the first to the last frame."""
    x, mesh = np.asarray(found.x), scenario.scene.mesh
    stretched = np.asarray(stretch(mesh, found.x))
    rest, area = np.asarray(mesh.rest), np.asarray(mesh.area)
    middles = rest[np.asarray(mesh.faces)].mean(axis=1)
    far = np.linalg.norm(middles[:, None] - rest[np.asarray(scenario.scene.held)][None], axis=2)
    energy = lambda name: np.asarray(getattr(found, name), float)
    gained = {f"{name}_mj": 1e3 * (energy(name)[-1] - energy(name)[0]) for name in ENERGIES}
    return {
        "finite": bool(np.all(np.isfinite(x))),
        "lowest_mm": 1e3 * float(x[..., 2].min() - scenario.scene.table.height),
        "contact_mm": 1e3 * thickness,
        "at_rest_percent": 100 * float(stretched[0].mean()),
        "mean_stretch_percent": 100 * float(stretched.mean(axis=1).max()),
        "above_5_percent": 100 * float(((stretched > 0.05) @ area).max() / area.sum()),
        "away_stretch_percent": 100 * float(stretched[:, far.min(axis=1) > GRIP].max()),
        "most_stretch_percent": 100 * float(stretched.max()),
        **gained,
        "least_dissipated_mj": 1e3 * float(np.diff(energy("dissipated")).min()),
        "least_fine_mj": np.nan,
    }


ENERGIES = ("stored", "kinetic", "potential", "grippers", "air", "dissipated")


def _number(name: str, digits: int = 2):
    return lambda row: f"{row[name]:.{digits}f}" if np.isfinite(row[name]) else "-"


COLUMNS = {
    "scenario": lambda row: row["scenario"],
    "solver": lambda row: row["solver"],
    "fabric": lambda row: row["fabric"],
    "s": _number("seconds", 1),
    "finite": lambda row: "yes" if row["finite"] else "no",
    "lowest mm": _number("lowest_mm"),
    "contact mm": _number("contact_mm"),
    "stretch at rest %": _number("at_rest_percent", 1),
    "mean %": _number("mean_stretch_percent", 1),
    "away %": _number("away_stretch_percent", 1),
    "most %": _number("most_stretch_percent", 1),
    "area above 5 %": _number("above_5_percent", 1),
    **{f"{name} mJ": _number(f"{name}_mj") for name in ENERGIES},
    "least in a frame": _number("least_dissipated_mj", 3),
    "with finer steps": _number("least_fine_mj", 3),
}


def table(rows: list[measure.Row], caption: str) -> Table:
    """The figures of runs."""
    lines = tuple(tuple(text(row) for text in COLUMNS.values()) for row in rows)
    return Table(tuple(COLUMNS), lines, caption)


def report(rows: list[measure.Row], out: Path) -> None:
    """`report.html` with every figure and every picture, and `scenarios.csv`."""
    everything = table(
        rows, "Six scenarios: figures, and energies from the first to the last frame"
    )
    header = tuple(rows[0])
    raw = tuple(tuple(str(row[name]) for name in header) for row in rows)
    write_text(out / "scenarios.csv", csv_text(Table(header, raw, "")))
    names = dict.fromkeys(row["scenario"] for row in rows)
    sections = [Section("All runs", tables=(everything,))]
    for name in names:
        caption = f"{name}: six frames of each run; dashed: the sheet in the first frame"
        of = scenarios.SIX[name].__doc__ or ""
        sections.append(
            Section(name, (of.split("\n")[0],), figures=((out / f"{name}.png", caption),))
        )
    settings = {name: str(value) for name, value in measure.machine().items()}
    settings |= {f"mesh of {kind}": f"{a} x {b} vertices" for kind, (a, b) in SOLVERS.items()}
    write_report(out / "report.html", "Six scenarios on both solvers", INTRO, settings, sections)


def main(out: Path, names: list[str], kinds: list[str]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in names:
        runs = []
        for kind in kinds:
            if kind == "layers" and name != "folding":
                continue  # the others do not touch themselves
            for fabric in FABRICS:
                measure.progress(f"{name}, {kind}, {fabric}")
                runs.append(run(name, kind, fabric))
        if not runs:
            continue
        drawn = [
            (
                scenario,
                np.asarray(found.x),
                f"{row['solver']}, {row['fabric']}",
                COLOURS[row["solver"]],
            )
            for scenario, found, row in runs
        ]
        picture(name, drawn, out / f"{name}.png")
        rows += [row for _, _, row in runs]
        measure.show(name, [row for _, _, row in runs], COLUMNS)
        report(rows, out)  # so that a run which is killed leaves what it has


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The six scenarios: figures and pictures.")
    parser.add_argument("--out", type=Path, default=Path("results/scenarios"))
    parser.add_argument("--only", nargs="*", default=list(scenarios.SIX), choices=scenarios.SIX)
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=SOLVERS)
    a = parser.parse_args()
    main(a.out, a.only, a.solvers)
