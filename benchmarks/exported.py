"""A fabric exported to MuJoCo and Newton, and how far it moves there from how it moves here.

    python benchmarks/exported.py                    # both, if installed: pip install 'r2s[bench]'
    python benchmarks/exported.py --only newton --fabrics black_denim

A sheet of 0.3 m starts flat and falls, in vacuum and without contact (not exported). "drape": its
four corners are brought together to 0.95 of their distances, and it sags and rests; compared
there. "lift": one corner is carried 0.2 m up and 0.1 m inward in a second, and stays; compared in
all frames. Distances are rms over the vertices (and frames), over the side. "isotropic" exports the
nearest isotropic sheet, "yarns" springs along warp and weft beside it. All have the same mesh, but
the others bend by hinges. "r2s, their bending" is ours with those hinges: what remains of a
difference from it is not of bending.

Damping is 0.2 ms instead of the presets' 10 ms, which explicit steps do not bear (Newton's would be
2 microseconds), and a mass damping of 3/s brings the sheets to rest.
"""

import argparse
import csv
import dataclasses
import functools
import importlib
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import measure
import numpy as np

import r2s
from r2s.export import stiffness
from r2s.fabrics import presets
from r2s.laws.bending import HingeBending
from r2s.units import GRAVITY
from r2s.world.air import Air
from r2s.world.contact import Table

SIDE, SIZE, HEIGHT = 0.3, 13, 0.5  # [m], vertices a side, [m]
RATE = 60.0  # frames a second
DAMPING, BRAKE = 2e-4, 3.0  # [s], [1/s]
STEPS = 4, 1  # of ours in a frame: what is compared, and the coarse ones beside it
FRAMES = {"drape": 180, "lift": 90}
ISOTROPIC = r2s.Fabric.make(0.2, (100.0, 30.0, 100.0, 35.0), 1e-5)
FABRICS = {
    "isotropic": lambda: ISOTROPIC,
    "grey_interlock": presets.grey_interlock,
    "black_denim": presets.black_denim,
}
PEERS = {"mujoco": "exported_mujoco", "newton": "exported_newton"}


def fabric_of(name: str) -> r2s.Fabric:
    """One of `FABRICS` with the benchmark's damping."""
    set_to = lambda value: jnp.asarray(value, float)
    return dataclasses.replace(FABRICS[name](), damping=set_to(DAMPING), mass_damping=set_to(BRAKE))


def eased(t: float, lasting: float) -> float:
    """From 0 to 1 in a time [s], at rest before and after."""
    progress = min(max(t / lasting, 0.0), 1.0)
    return progress**2 * (3 - 2 * progress)


def path_of(scene: str, start: np.ndarray):
    """Which vertices are held, and their places [m] as a function of time [s]."""
    if scene == "drape":
        held = (0, SIZE - 1, SIZE**2 - SIZE, SIZE**2 - 1)
        corners = start[list(held)]
        inward = 0.05 * (corners.mean(axis=0) - corners)
        return held, lambda t: corners + eased(t, 1.0) * inward
    return (0,), lambda t: start[[0]] + eased(t, 1.0) * np.array([[0.07, 0.07, 0.2]])


@functools.cache
def _solver(scene: str, substeps: int):
    mesh = r2s.rectangle((SIDE, SIDE), (SIZE, SIZE))
    start = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)), constant_values=0.0)
    start[:, 2] = HEIGHT
    held, path = path_of(scene, start)
    setting = r2s.Scene(mesh, jnp.array(held), Table.make(-jnp.inf), Air.make(density=0.0))
    solver = r2s.Cloth.make(setting, 1 / (RATE * substeps))
    frames = FRAMES[scene]
    times = np.arange(1, frames * substeps + 1) / (RATE * substeps)
    handles = np.stack([path(t) for t in times]).reshape(frames, substeps, len(held), 3)
    controls = r2s.Control(jnp.asarray(handles, float), jnp.zeros((frames, substeps, 3)))
    falling = jnp.where(setting.is_free[:, None], jnp.array([[0.0, 0.0, -GRAVITY]]), 0)
    return solver, jnp.asarray(start, float), falling, controls, held, path


@eqx.filter_jit
def _ours(solver, fabric, start, falling, controls):
    return r2s.simulate(solver, fabric, solver.init(start, acceleration=falling), controls).x


def distance(scene: str, x: np.ndarray, y: np.ndarray) -> float:
    """Rms over vertices (and frames) over the side [-]; not finite when one diverged."""
    kept = slice(-1, None) if scene == "drape" else slice(None)
    squared = np.sum((x[kept].astype(float) - y[kept]) ** 2, axis=-1)
    return float(np.sqrt(squared.mean())) / SIDE


def compare(name: str, scene: str, peers: list[str]) -> list[measure.Row]:
    """One fabric in one scene: all against ours."""
    fabric = fabric_of(name)
    fine, coarse = (np.asarray(_ours(*_inputs(scene, n, fabric))) for n in STEPS)
    solver, _, _, _, held, path = _solver(scene, STEPS[0])
    mesh = solver.scene.mesh
    law = HingeBending(jnp.asarray(stiffness.hinge_stiffness(fabric, mesh), float))
    bent = dataclasses.replace(fabric, bending=law)
    hinged = np.asarray(_ours(*_inputs(scene, STEPS[0], bent)))
    moved = float(np.sqrt(np.mean(np.sum((fine[-1] - fine[0]) ** 2, axis=-1)))) / SIDE
    about = {"fabric": name, "scene": scene, "moved": moved}
    rows: list[measure.Row] = []

    def add(system: str, x: np.ndarray, export: str = "-", loss=None, seconds=None) -> None:
        apart = {"apart": distance(scene, x, fine), "apart_hinges": distance(scene, x, hinged)}
        worst = loss and max(map(abs, loss.membrane.values()))
        parts = {"membrane": worst, "bending": loss and max(map(abs, loss.bending.values()))}
        rows.append(about | {"system": system, "export": export} | apart | parts)
        rows[-1]["cpu_s"] = seconds

    add("r2s, steps of 17 ms", coarse)
    add("r2s, their bending", hinged)
    for peer in peers:
        module = importlib.import_module(PEERS[peer])
        for yarns in (False, True):
            measure.progress(f"{name}, {scene}: {peer}{', yarns' if yarns else ''}")
            before = time.process_time()
            x, loss = module.motion(fabric, mesh, held, path, FRAMES[scene], RATE, yarns)
            export = "yarns" if yarns else "isotropic"
            add(peer, x, export, loss, time.process_time() - before)
    return rows


def _inputs(scene: str, substeps: int, fabric):
    solver, start, falling, controls, _, _ = _solver(scene, substeps)
    return solver, fabric, start, falling, controls


def installed(wanted: str) -> list[str]:
    """The peers that are installed; says which are not."""
    found = []
    for peer, module in PEERS.items():
        if wanted not in ("", peer):
            continue
        try:
            importlib.import_module(module)
            found.append(peer)
        except ImportError as error:
            measure.progress(f"{peer} is left out: {error}: pip install 'r2s[bench]'")
    return found


def _percent(name: str):
    return lambda row: "-" if row[name] is None else f"{row[name]:.1%}"


COLUMNS = {
    "fabric": lambda row: row["fabric"],
    "scene": lambda row: row["scene"],
    "system": lambda row: row["system"],
    "export": lambda row: row["export"],
    "from r2s": _percent("apart"),
    "from r2s, their bending": _percent("apart_hinges"),
    "moved": _percent("moved"),
    "worst membrane probe": _percent("membrane"),
    "worst bending probe": _percent("bending"),
    "CPU s": lambda row: "-" if row["cpu_s"] is None else f"{row['cpu_s']:.1f}",
}


def main(out: Path, only: str, fabrics: list[str], scenes: list[str]) -> list[measure.Row]:
    """All rows, printed and written to OUT/exported.csv as they come."""
    peers, rows = installed(only), []
    out.mkdir(parents=True, exist_ok=True)
    for scene in scenes:
        for name in fabrics:
            rows += compare(name, scene, peers)
            with open(out / "exported.csv", "w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
    measure.show("exported fabrics; rms distances over the side of the sheet", rows, COLUMNS)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Exported fabrics beside ours.")
    parser.add_argument("--out", type=Path, default=Path("results/exported"))
    parser.add_argument("--only", default="", choices=("", *PEERS))
    parser.add_argument("--fabrics", nargs="+", default=list(FABRICS), choices=list(FABRICS))
    parser.add_argument("--scenes", nargs="+", default=list(FRAMES), choices=list(FRAMES))
    a = parser.parse_args()
    main(a.out, a.only, a.fabrics, a.scenes)
