"""A fabric estimated from what another simulator made, and how well it predicts that one's runs.

python benchmarks/another_simulator.py --out results/another_simulator

Some CPU minutes, most of them compilation.

DiffSim (Qiao et al. 2020) let a sheet of 1 m fall, held by a corner or two or by an edge, and blew
at it; `--data` has its trajectories. From point clouds of the first 0.4 s of its lift and of its
rest shape under two corners a fabric is estimated, and with that the rest shape under the edge and
the first 0.4 s in the wind are predicted. Beside it stand DiffSim's own laws in the cloth of r2s,
the default fabric, and DiffSim in steps of 40 ms.

A run there is a linearised backward-Euler step of 10 ms after the other: it damps like a damping
time of 10 ms, and a falling sheet is where it should be 5 ms later. So damping is estimated along,
and in one of two ways the clock of the lift (`NuisancePrior`), at which the wind is then predicted
too. Estimates are kept in `--out`, and go on from there.
"""

import argparse
import csv
import json
import time
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.interpolate import CubicSpline

from r2s.cloth.linear.elimination import Elimination
from r2s.estimation import diffcloud
from r2s.estimation.descent import Budget
from r2s.estimation.estimate import Estimate
from r2s.estimation.problem import Clouds, NuisancePrior, Problem
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.geometry.mesh import Mesh
from r2s.laws.tables import DiffSimTableBending, DiffSimTableMembrane
from r2s.scenarios.scenario import BRAKE, Scenario, rollout
from r2s.units import GRAVITY
from r2s.world.air import Air
from r2s.world.contact import Table
from r2s.world.scene import Scene

DATA = Path(__file__).parents[2] / "shared" / "data" / "diffsim_reference"
FABRICS = ("camel", "denim")
LIFT, REST, EDGE = "lift1_{}_9_dt10", "rest_{}_9_dt40", "edge_{}_9_dt40"
WIND, COARSE_WIND = "hang2wind_{}_9_dt10", "hang2wind_{}_9_dt40"
FRAME, COUNT = 0.04, 10  # [s] between frames; how many of a motion count, the first at 0.04 s
STEPS, REST_STEPS = 4, 2  # of r2s in a frame
SETTLING = 90  # frames in which a braked sheet comes to rest
NO_DOUBT = NuisancePrior(0.0, 0.0)
NOISE = 1e-3  # [m], of the clouds
BAR = 0.02  # of the side

_motion = eqx.filter_jit(rollout)


class Made(NamedTuple):
    """A run of the other simulator.

    - `mesh`, `held`: the sheet and its held vertices. `start`: positions at rest, [m].
    - `times`, `x`, `handles`: of the frames [s], vertices and handles in them [m].
    - `told`: its settings.
    """

    mesh: Mesh
    held: Int[np.ndarray, " handle"]
    start: Float[np.ndarray, "vertex 3"]
    times: Float[np.ndarray, " frame"]
    x: Float[np.ndarray, "frame vertex 3"]
    handles: Float[np.ndarray, "frame handle 3"]
    told: dict


def read(folder: Path, name: str) -> Made:
    """A run. Raises `FileNotFoundError` without its files, `ValueError` for air not as in r2s."""
    path = folder / f"{name}.npz"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such trajectory; --data names their folder")
    told, arrays = json.loads(path.with_suffix(".json").read_text()), np.load(path)
    if told["wind"]["drag"] != 0:
        raise ValueError(f"{path}: expected no drag along the faces, got {told['wind']['drag']}")
    return Made(
        Mesh.make(arrays["rest_uv"], arrays["faces"].astype(int)),
        arrays["handle_vertices"].astype(int),
        arrays["initial_position"],
        arrays["time"],
        arrays["position"],
        arrays["handle_target"],
        told,
    )


def first_acceleration(made: Made) -> Float[np.ndarray, "vertex 3"]:
    """Of a sheet that is let go at rest [m/s^2]: gravity and wind, but for the held vertices."""
    faces = np.asarray(made.mesh.faces)
    corners = made.start[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2  # [m^2]
    area = np.linalg.norm(normal, axis=1)
    flow = normal @ np.asarray(made.told["wind"]["velocity"], float) / area
    thrust = (made.told["wind"]["density"] * np.abs(flow) * flow)[:, None] * normal
    force = np.zeros_like(made.start)
    np.add.at(force, faces, np.repeat(thrust[:, None] / 3, 3, axis=1))
    mass = made.told["material_json"]["density"] * np.asarray(made.mesh.vertex_area)
    acceleration = force / mass[:, None] - np.array([0.0, 0.0, GRAVITY])
    acceleration[made.held] = 0
    return acceleration


def scenario_of(made: Made, at_rest: bool = False) -> Scenario:
    """The run as an experiment of r2s: `COUNT` frames, the first one `FRAME` after the start.

    Two more are simulated, for clocks that are early. `at_rest`: they come after the sheet, which
    falls from where it starts, was braked for `SETTLING` frames.
    """
    array = lambda value: jnp.asarray(value, float)
    wind = np.asarray(made.told["wind"]["velocity"], float)
    handles, times = np.array(made.handles), made.times
    handles[0] = made.start[made.held]
    if at_rest:
        handles, times = np.repeat(handles[:1], 2, axis=0), np.array([0.0, 1.0])
    lead_in = SETTLING if at_rest else 1
    air = Air.make(made.told["wind"]["density"], drag_coefficient=2.0, friction_coefficient=0.0)
    return Scenario(
        scene=Scene(made.mesh, jnp.asarray(made.held), Table.make(-jnp.inf), air),
        elimination=Elimination.make(made.mesh),
        start=array(made.start),
        path=array(handles),
        path_times=array(times),
        first_time=array(lead_in * FRAME),
        interval=FRAME,
        num_frames=COUNT + 2,
        lead_in=lead_in,
        substeps=REST_STEPS if at_rest else STEPS,
        wind=array(np.stack([wind, wind])),
        wind_times=array([0.0, 1.0]),
        brake=array(BRAKE) if at_rest else None,
        acceleration=array(first_acceleration(made)),
    )


def truth(made: Made, at_rest: bool = False) -> Float[np.ndarray, "frame vertex 3"]:
    """Its vertices in the frames that count [m]: after the start, or again and again at rest."""
    if at_rest:
        return np.repeat(made.x[-1:], COUNT, axis=0)
    expected = FRAME * np.arange(1, COUNT + 1)
    if np.max(np.abs(made.times[1 : COUNT + 1] - expected)) > 1e-9:
        raise ValueError(f"frames must be {FRAME} s apart, got times {made.times[:3]} s")
    return made.x[1 : COUNT + 1]


def sampled(
    x: Float[np.ndarray, "frame vertex 3"],
    mesh: Mesh,
    number: int,
    key: PRNGKeyArray,
    noise: float = NOISE,
) -> Clouds:
    """Points on a sheet, evenly spread over its area at rest, with noise [m] in every direction."""
    which, where, off = jax.random.split(key, 3)
    frames = x.shape[0]
    share = mesh.area / jnp.sum(mesh.area)
    face = jax.random.choice(which, mesh.faces.shape[0], (frames, number), p=share)
    weights = jax.random.dirichlet(where, jnp.ones(3, float), (frames, number))
    corners = jnp.asarray(x, float)[jnp.arange(frames)[:, None, None], mesh.faces[face]]
    points = jnp.einsum("fpk,fpki->fpi", weights, corners)
    points = points + noise * jax.random.normal(off, points.shape, float)
    return Clouds(points, jnp.ones((frames, number), bool))


def problems_of(
    folder: Path, fabric: str, number: int, clock: float, key: PRNGKeyArray
) -> tuple[Problem, Problem]:
    """Clouds, of `number` points, of the lift and of the rest shape under two corners.

    `clock` [s] is the doubt of the lift's clock.
    """
    found = []
    for i, (name, at_rest) in enumerate(((LIFT, False), (REST, True))):
        made = read(folder, name.format(fabric))
        space = OrthotropicSpace.make(made.told["material_json"]["density"])
        clouds = sampled(truth(made, at_rest), made.mesh, number, jax.random.fold_in(key, i))
        nuisance_prior = NO_DOUBT if at_rest else NO_DOUBT._replace(time=clock)
        scenario = scenario_of(made, at_rest)
        found.append(
            Problem(scenario, space, tuple(range(COUNT)), clouds, nuisance_prior=nuisance_prior)
        )
    return found[0], found[1]


def clock_of(estimate: Estimate) -> float:
    """By how much the lift's clock is late [s]; negative: early; 0 when it was not in doubt."""
    return next((c.value for c in estimate.nuisances if c.name == "time 1"), 0.0)


def own_fabric(made: Made, damping: float) -> Fabric:
    """The tables that the other simulator was given, and its way to look them up."""
    table = lambda name: jnp.asarray(made.told["material_json"][name], float)
    zero = jnp.zeros((), float)
    laws = DiffSimTableMembrane(table("stretching")), DiffSimTableBending(table("bending"))
    damping_time, thickness = jnp.asarray(damping, float), jnp.asarray(1e-3, float)
    return Fabric(table("density"), *laws, damping_time, zero, thickness, zero)


def predicted(
    made: Made, fabric: Fabric, at_rest: bool = False, clock: float = 0.0
) -> Float[np.ndarray, "frame vertex 3"]:
    """The vertices that a fabric would show [m] in the frames that count of a clock that is late.

    Raises `RuntimeError` when the run diverged.
    """
    moved = _motion(scenario_of(made, at_rest), fabric)
    if not bool(jnp.all(moved.ok)):
        raise RuntimeError(f"{made.told['name']}: the simulation of r2s diverged")
    x = np.asarray(moved.x, np.float64)
    if at_rest or clock == 0:
        return x[:COUNT]
    times = FRAME * np.arange(len(x) + 1)
    return CubicSpline(times, np.concatenate([made.start[None], x]))(times[1 : COUNT + 1] - clock)


def errors(found: np.ndarray, made: np.ndarray) -> tuple[np.ndarray, float]:
    """Root mean square over the vertices, of each frame, and the worst vertex of all [m]."""
    away = np.linalg.norm(found - made, axis=-1)
    return np.sqrt(np.mean(away**2, axis=1)), float(np.max(away))


def judged(
    folder: Path, fabric: str, who: str, law: Fabric, clock: float
) -> tuple[measure.Row, np.ndarray]:
    """The errors of a fabric in all four runs [% of the side], and its vertices in the wind."""
    row: measure.Row = {"fabric": fabric, "who": who, "clock_ms": 1e3 * clock}
    x = np.zeros(0)
    for label, name, at_rest in (
        ("lift", LIFT, False),
        ("rest", REST, True),
        ("edge", EDGE, True),
        ("wind", WIND, False),
    ):
        made = read(folder, name.format(fabric))
        x = predicted(made, law, at_rest, clock)
        row |= _percent(label, made, x, truth(made, at_rest))
    return row, x


def _percent(label: str, made: Made, found: np.ndarray, expected: np.ndarray) -> measure.Row:
    each, worst = errors(found, expected)
    side = float(np.max(np.ptp(np.asarray(made.mesh.rest), axis=0)))
    return {f"{label}_rms": 100 * float(np.max(each)) / side, f"{label}_worst": 100 * worst / side}


def estimated(
    folder: Path,
    fabric: str,
    number: int,
    clock: float,
    budget: Budget,
    path: Path | None = None,
) -> Estimate:
    """The fabric of known density from clouds of its lift and its rest shape (`problems_of`)."""
    problems = problems_of(folder, fabric, number, clock, jax.random.key(0))
    return diffcloud.estimate(problems, budget, checkpoint=path, key=jax.random.key(1))


WAYS = {"plain": 0.0, "clock": 0.01}  # [s], the doubt of the lift's clock


def compare(folder: Path, fabric: str, ways: list[str], number: int, budget: Budget, out: Path):
    """Rows of all fabrics that stand beside each other, and their vertices in the wind [m]."""
    wind = read(folder, WIND.format(fabric))
    density, dt = wind.told["material_json"]["density"], wind.told["dt"]
    candidates, told = [], []
    for way in ways:
        began = time.process_time()
        path = out / f"{fabric}_{way}.npz"
        found = estimated(folder, fabric, number, WAYS[way], budget, path)
        measure.progress(f"{fabric}, {way}: {time.process_time() - began:.0f} CPU s")
        candidates.append((f"estimate, {way}", found.fabric, clock_of(found)))
        told += parameters(fabric, way, found)
    candidates += [
        ("its laws", own_fabric(wind, 0.0), 0.0),
        ("its laws, damped and early as its steps", own_fabric(wind, dt), -dt / 2),
        ("default", OrthotropicSpace.make(density).middle(), 0.0),
    ]
    rows, seen = [], {}
    for candidate in candidates:
        row, seen[candidate[0]] = judged(folder, fabric, *candidate)
        rows.append(row)
    coarse = truth(read(folder, COARSE_WIND.format(fabric)))
    errors_of_steps = _percent("wind", wind, coarse, truth(wind))
    rows.append({"fabric": fabric, "who": "itself in steps of 40 ms"} | errors_of_steps)
    return rows, told, seen | {"DiffSim": truth(wind)}


def parameters(fabric: str, way: str, found: Estimate) -> list[measure.Row]:
    """What was estimated, one row a number."""
    rows = zip(found.ranges, found.values, found.standard_errors, found.identifiable, strict=True)
    listed = [(b.name, b.unit, float(v), float(d), bool(sure)) for b, v, d, sure in rows]
    listed += [(c.name, c.unit, c.value, c.deviation, True) for c in found.nuisances]
    names = ("parameter", "unit", "value", "deviation", "determined")
    return [{"fabric": fabric, "way": way} | dict(zip(names, each, strict=True)) for each in listed]


def write(path: Path, rows: list[measure.Row]) -> None:
    """Rows as CSV; what a row lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def picture(path: Path, seen: dict[str, dict[str, np.ndarray]]) -> None:
    """Errors in the wind against time, and the sheets from the side at the end, a row a fabric."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4 * len(seen)), layout="constrained")
    for line, (fabric, runs) in enumerate(seen.items()):
        error = figure.add_subplot(len(seen), 2, 2 * line + 1)
        side = figure.add_subplot(len(seen), 2, 2 * line + 2)
        expected = runs["DiffSim"]
        side.scatter(expected[-1, :, 1], expected[-1, :, 2], s=22, c="black", label="DiffSim")
        for colour, (who, x) in enumerate((k, v) for k, v in runs.items() if k != "DiffSim"):
            times = FRAME * np.arange(1, COUNT + 1)
            error.plot(times, 100 * errors(x, expected)[0], f"C{colour}.-", label=who)
            if who.startswith("estimate") or who == "default":
                side.scatter(x[-1, :, 1], x[-1, :, 2], s=8, c=f"C{colour}", label=who)
        error.axhline(100 * BAR, color="grey", linestyle=":")
        error.set(xlabel="time [s]", ylabel="rms distance [% of the side]")
        error.set(yscale="log", ylim=(0.03, 20), title=f"{fabric}: off DiffSim in the wind")
        side.set(xlabel="along the wind, y [m]", ylabel="height, z [m]", aspect="equal")
        side.set_title(f"{fabric}: from the side at 0.4 s")
        error.legend(fontsize=8, loc="lower right")
        side.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main(folder: Path, out: Path, fabrics: list[str], ways: list[str], number: int, budget: Budget):
    out.mkdir(parents=True, exist_ok=True)
    rows, told, seen = [], [], {}
    for fabric in fabrics:
        more, estimates, seen[fabric] = compare(folder, fabric, ways, number, budget, out)
        rows, told = rows + more, told + estimates
        write(out / "errors.csv", rows)
        write(out / "estimates.csv", told)
    picture(out / "wind.png", seen)
    both = lambda label: (
        lambda row: (
            f"{row[f'{label}_rms']:.2f} / {row[f'{label}_worst']:.2f}"
            if f"{label}_rms" in row
            else "-"
        )
    )
    columns = {
        "fabric": lambda row: row["fabric"],
        "": lambda row: row["who"],
        "clock [ms]": lambda row: f"{row['clock_ms']:.1f}" if "clock_ms" in row else "-",
        **{label: both(label) for label in ("lift", "rest", "edge", "wind")},
    }
    title = "rms of the worst frame / worst vertex [% of the side]; lift and rest were seen"
    measure.show(title, rows, columns)
    number_of = lambda row: f"{row['value']:.4g} +- {row['deviation']:.2g} {row['unit']}"
    named = ("fabric", "way", "parameter")
    columns = {name: lambda row, name=name: row[name] for name in named} | {"value": number_of}
    measure.show("estimates (deviations relative where the range is logarithmic)", told, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A fabric from another simulator's motion.")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the trajectories")
    parser.add_argument("--out", type=Path, default=Path("results/another_simulator"))
    parser.add_argument("--fabrics", nargs="+", default=list(FABRICS), choices=FABRICS)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--points", type=int, default=2000, help="of a cloud")
    parser.add_argument("--coarse", type=int, default=24, help="places that are tried first")
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=20)
    a = parser.parse_args()
    budget = Budget(a.coarse, a.starts, a.iterations)
    main(a.data, a.out, a.fabrics, a.ways, a.points, budget)
