"""The six scenarios on both solvers, for the softest and the stiffest preset: figures and pictures.

python benchmarks/scenarios.py --out results/scenarios        # about 15 minutes on one core

Prints, and writes to `scenarios.csv`, of every run: whether it is finite, how deep it is in the
table, how far its faces are stretched, and where the energy went since the first frame. Draws one
picture a scenario: six frames of every run.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import measure
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from r2s import presets, scenarios
from r2s.scenario import Scenario
from r2s.scenarios.account import Account, stretch

FABRICS = ("grey_interlock", "black_denim")  # softest and stiffest membrane of the five
SOLVERS = {"cloth": (13, 13), "layers": (9, 9), "points": (13, 13)}  # vertices of their meshes
COLOURS = {"cloth": "#4c8bc0", "layers": "#3c9c79", "points": "#d08a3e"}
VIEWS = {"lifting": (25, -50), "folding": (30, -40), "stretching": (60, -60)}  # degrees
SIDEWAYS = (12, -35)  # of hanging sheets
PANELS = 6

_account = eqx.filter_jit(scenarios.account)


def run(name: str, kind: str, fabric_name: str) -> tuple[Scenario, Account, measure.Row]:
    """A scenario by a solver with a preset, and the row of its figures."""
    fabric = presets.FIVE[fabric_name]()
    scenario = scenarios.SIX[name]().scenario(SOLVERS[kind], layers=kind == "layers")
    solver = scenarios.material_points(scenario, fabric) if kind == "points" else None
    before = time.perf_counter()
    found: Account = jax.block_until_ready(_account(scenario, fabric, None, solver))
    seconds = time.perf_counter() - before
    row = {"scenario": name, "solver": kind, "fabric": fabric_name, "seconds": seconds}
    return scenario, found, row | figures_of(scenario, found, float(fabric.thickness))


def figures_of(scenario: Scenario, found: Account, thickness: float) -> measure.Row:
    """What has to hold of a motion, and its energy account from the first to the last frame."""
    x = np.asarray(found.x)
    stretched = np.asarray(stretch(scenario.scene.mesh, found.x))
    energy = lambda name: np.asarray(getattr(found, name), float)
    gained = {f"{name}_mj": 1e3 * (energy(name)[-1] - energy(name)[0]) for name in ENERGIES}
    return {
        "finite": bool(np.all(np.isfinite(x))),
        "lowest_mm": 1e3 * float(x[..., 2].min() - scenario.scene.table.height),
        "contact_mm": 1e3 * thickness,
        "at_rest_percent": 100 * float(stretched[0].mean()),
        "mean_stretch_percent": 100 * float(stretched.mean(axis=1).max()),
        "most_stretch_percent": 100 * float(stretched.max()),
        **gained,
        "least_dissipated_mj": 1e3 * float(np.diff(energy("dissipated")).min()),
    }


ENERGIES = ("stored", "kinetic", "potential", "grippers", "air", "dissipated")


def picture(name: str, runs: list[tuple[Scenario, Account, measure.Row]], out: Path) -> None:
    """Six frames of every run of a scenario, a row a run."""
    figure = Figure(figsize=(2.6 * PANELS, 2.4 * len(runs) + 0.5), layout="constrained")
    figure.suptitle(name)
    low, high = _box([np.asarray(found.x) for _, found, _ in runs])
    for line, (scenario, found, row) in enumerate(runs):
        frames = np.linspace(0, len(found.x) - 1, PANELS).round().astype(int)
        for place, frame in enumerate(frames):
            index = line * PANELS + place + 1
            axes: Any = figure.add_subplot(len(runs), PANELS, index, projection="3d")
            draw(axes, scenario, np.asarray(found.x)[frame], low, high, COLOURS[row["solver"]])
            axes.view_init(*VIEWS.get(name, SIDEWAYS))
            axes.set_title(f"{frame * scenario.interval:.2f} s", fontsize=8, pad=0)
            if place == 0:
                text = f"{row['solver']}, {row['fabric']}"
                axes.text2D(0, 1.08, text, transform=axes.transAxes, fontsize=9)
    figure.savefig(out / f"{name}.png", dpi=90)


def draw(axes: Any, scenario: Scenario, x: np.ndarray, low: Any, high: Any, colour: str) -> None:
    """A sheet, shaded, with its held vertices and the table below it."""
    faces = np.asarray(scenario.scene.mesh.faces)
    corners = x[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = np.zeros_like(x)
    np.add.at(smooth, faces, normals[:, None])
    smooth = smooth[faces].sum(axis=1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    light = np.abs(smooth @ np.array([0.35, -0.6, 0.72]))[:, None]
    shades = np.clip((0.3 + 0.75 * light) * np.array(to_rgb(colour)), 0, 1)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=shades, edgecolors=shades, lw=0.2))
    axes.scatter(*x[np.asarray(scenario.scene.held)].T, s=5, color="black", depthshade=False)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(3))
    axes.tick_params(labelsize=5, pad=-4)


def _box(motions: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([x.reshape(-1, 3) for x in motions])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 0.05)
    return middle - half, middle + half


def show(rows: list[measure.Row]) -> None:
    """The table of all runs."""
    number = lambda name, digits=2: lambda row: f"{row[name]:.{digits}f}"
    columns = {
        "scenario": lambda row: row["scenario"],
        "solver": lambda row: row["solver"],
        "fabric": lambda row: row["fabric"],
        "s": number("seconds", 1),
        "finite": lambda row: str(row["finite"]),
        "lowest mm": number("lowest_mm"),
        "stretch at rest %": number("at_rest_percent", 1),
        "mean": number("mean_stretch_percent", 1),
        "most": number("most_stretch_percent", 1),
        **{f"{name} mJ": number(f"{name}_mj") for name in ENERGIES},
        "least in a frame": number("least_dissipated_mj"),
    }
    measure.show("six scenarios: energies gained or given, first to last frame", rows, columns)


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
        picture(name, runs, out)
        rows += [row for _, _, row in runs]
        show(rows[-len(runs) :])
    with open(out / "scenarios.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The six scenarios: figures and pictures.")
    parser.add_argument("--out", type=Path, default=Path("results/scenarios"))
    parser.add_argument("--only", nargs="*", default=list(scenarios.SIX), choices=scenarios.SIX)
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=SOLVERS)
    a = parser.parse_args()
    main(a.out, a.only, a.solvers)
