"""How often an estimate arrives, from anywhere in the range: r2s beside the recipe and CMA-ES.

python benchmarks/estimators.py --starts 20 --out results/estimators     # hours on one core
python benchmarks/estimators.py --fabrics grey_interlock --starts 2 --methods ours
python benchmarks/estimators.py --points --methods ours recipe --starts 3 --out results/points

On the cloth, or with `--points` on material points: isotropic sheets with the presets' mean
stiffness, 7 x 7 vertices, seen in the steps of the estimate. Every start is a random place of the
space; the recording of a fabric is one and the same. A method succeeds when every parameter that
the recording determines (by the deviations of a descent from the true fabric) is within 5 % of the
truth; it arrives when its loss is that of the descent from the truth. What is done is kept in
`runs.csv`, not made again.
"""

import argparse
import csv
import itertools
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np

from r2s import scenarios
from r2s.estimation import cma_es, diffcloud, diffcp, gauss_newton
from r2s.estimation.descent import DEFAULT, descend
from r2s.estimation.estimate import Estimate
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import IsotropicSpace, OrthotropicSpace
from r2s.scenarios import synthetic
from r2s.scenarios.on_points import material_points

_loss = eqx.filter_jit(gauss_newton.loss_at)
COARSE, INSIDE = (7, 7), (0.1, 0.9)  # of the problems on material points
SAME = 1.05  # times the loss at the truth's descent: the same place


def alone(problem: Problem, start, key) -> Estimate:
    """Gauss-Newton from the start, and from nowhere else."""
    budget = DEFAULT if problem.solver is None else diffcp.DEFAULT
    return descend(problem, budget._replace(coarse=0, starts=1), start=start, key=key)


def ours(problem: Problem, start, key) -> Estimate:
    """The default estimator of the problem's solver."""
    budget = DEFAULT if problem.solver is None else diffcp.DEFAULT
    return descend(problem, budget, start=start, key=key)


def recipe(problem: Problem, start, key) -> Estimate:
    """The published one, from the start."""
    if problem.solver is None:
        return diffcloud.published_recipe(problem, None, start=start)
    return diffcp.published_recipe(problem, start=start)


METHODS: dict[str, Callable] = {
    "ours": ours,
    "ours, no search": alone,
    "recipe": recipe,
    "cma": lambda p, start, key: cma_es.search(p, start=start, key=key),
}


def problem_of(name: str, scenario: str, points: bool) -> tuple[Problem, np.ndarray]:
    """The problem of a preset, and its true place."""
    fabric = presets.FIVE[name]()
    key = jax.random.key(0)
    if points:
        return _on_points(IsotropicSpace.make(float(fabric.density)), fabric, name, scenario, key)
    space = OrthotropicSpace.make(float(fabric.density))
    recording = synthetic.record(scenarios.SIX[scenario](), fabric, name, key=key)
    return Problem.make(recording, space), np.asarray(space.to_unit(fabric))


def _on_points(space: IsotropicSpace, fabric: Fabric, name: str, scenario: str, key):
    """As `problem_of`, for the member of the space that is nearest to the fabric."""
    place = np.clip(np.asarray(space.to_unit(fabric)), *INSIDE)
    truth = space(jnp.asarray(place, float))
    stiffest = space(jnp.ones(space.dim, float))  # whose steps the estimate has, too
    recording = synthetic.record(
        scenarios.SIX[scenario](),
        truth,
        name,
        shape=COARSE,
        solver=lambda scenario, fabric: material_points(scenario, stiffest),
        key=key,
    )
    problem = Problem.make(recording, space, shape=COARSE, as_seen=False)
    return diffcp.on_points(problem), place


def errors(problem: Problem, estimate: Estimate, place: np.ndarray) -> np.ndarray:
    """Relative, or absolute where a range is linear."""
    truth = np.asarray(problem.space.values(jnp.asarray(place, float)))
    log = np.array([bound.log for bound in problem.space.ranges])
    ratio = np.where(log, estimate.values / np.where(log, truth, 1), 1)
    return np.where(log, ratio - 1, estimate.values - truth)


def loss_of(problem: Problem, estimate: Estimate) -> float:
    """The default loss [m^2] of an estimate's fabric, cameras as written down."""
    rest = jnp.zeros(gauss_newton.theta_length((problem,)) - problem.space.dim, float)
    return float(_loss((problem,), jnp.concatenate([problem.space.to_unit(estimate.fabric), rest])))


def attempt(problem: Problem, place: np.ndarray, method: str, number: int) -> measure.Row:
    """One estimate from a random start: its errors, loss [m^2] and times [s]."""
    key = jax.random.key(100 + number)
    start = jax.random.uniform(key, (problem.space.dim,), float)
    before, clock = time.perf_counter(), time.process_time()
    try:
        found = METHODS[method](problem, start, key)
    except RuntimeError:
        return {
            "errors": np.full(problem.space.dim, np.nan),
            "deviations": np.full(problem.space.dim, np.nan),
            "loss": np.inf,
            "seconds": np.nan,
            "cpu_seconds": np.nan,
        }
    seconds, cpu = time.perf_counter() - before, time.process_time() - clock
    wrong = errors(problem, found, place)
    return {
        "errors": wrong,
        "deviations": found.standard_errors,
        "loss": loss_of(problem, found),
        "seconds": seconds,
        "cpu_seconds": cpu,
    }


def run(
    out: Path, fabrics: list[str], scenario: str, methods: list[str], starts: int, points: bool
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    path = out / "runs.csv"
    rows: list[dict] = list(csv.DictReader(open(path))) if path.exists() else []
    for name in fabrics:
        problem, place = problem_of(name, scenario, points)
        best = alone(problem, jnp.asarray(place, float), jax.random.key(0))
        known = ", ".join(f"{d:.3f}" for d in best.standard_errors)
        measure.progress(f"{name}: deviations {known} from the truth")
        floor = loss_of(problem, best)
        for method, number in itertools.product(methods, range(starts)):
            label = {"scenario": scenario, "fabric": name, "method": method, "start": str(number)}
            if any(label.items() <= row.items() for row in rows):
                continue
            measure.progress(", ".join(label.values()))
            found = attempt(problem, place, method, number)
            worst = float(np.max(np.abs(found["errors"][best.identifiable]), initial=0.0))
            rows.append(
                label
                | {
                    "determined": int(best.identifiable.sum()),
                    "worst": worst,
                    "within": worst <= 0.05,
                    "arrived": found["loss"] <= SAME * floor,
                    "loss_mm2": 1e6 * found["loss"],
                    "seconds": found["seconds"],
                    "cpu_seconds": found["cpu_seconds"],
                    "errors": " ".join(f"{e:.4f}" for e in found["errors"]),
                    "deviations": " ".join(f"{d:.4f}" for d in found["deviations"]),
                }
            )
            with open(path, "w", newline="") as file:
                writer = csv.DictWriter(file, rows[0])
                writer.writeheader()
                writer.writerows(rows)
    summary(rows)


def _share(rows: list[dict], name: str) -> float:
    return float(np.mean([str(row[name]) == "True" for row in rows]))


def summary(rows: list[dict]) -> None:
    """One line a fabric and method."""
    groups: dict[tuple[str, str, str], list[dict]] = {}
    for row in rows:
        for fabric in (row["fabric"], "all"):
            groups.setdefault((row["scenario"], row["method"], fabric), []).append(row)
    lines = []
    for (scenario, method, fabric), members in groups.items():
        seconds = np.array([float(r["cpu_seconds"]) for r in members])
        lines.append(
            {
                "scenario": scenario,
                "method": method,
                "fabric": fabric,
                "starts": len(members),
                "within 5 %": _share(members, "within"),
                "arrived": _share(members, "arrived"),
                "median s": np.median(seconds),
                "worst s": seconds.max(),
                "median error": np.median([float(r["worst"]) for r in members]),
            }
        )
    text = {name: (lambda row, name=name: row[name]) for name in ("scenario", "method", "fabric")}
    count = {"starts": lambda row: f"{row['starts']}"}
    share = {n: (lambda row, n=n: f"{row[n]:.0%}") for n in ("within 5 %", "arrived")}
    times = {n: (lambda row, n=n: f"{row[n]:.1f}") for n in ("median s", "worst s")}
    error = {"median error": lambda row: f"{row['median error']:.1%}"}
    measure.show("estimates from random starts", lines, text | count | share | times | error)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimates from random starts.")
    parser.add_argument("--out", type=Path, default=Path("results/estimators"))
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE))
    parser.add_argument("--scenario", default="lifting", choices=("lifting", "wind", "stretching"))
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--points", action="store_true", help="material points, not the cloth")
    a = parser.parse_args()
    run(a.out, a.fabrics, a.scenario, a.methods, a.starts, a.points)
