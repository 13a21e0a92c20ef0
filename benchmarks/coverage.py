"""Whether intervals hold the truth: 50 noisy recordings, five presets, ten keys of noise each.

python benchmarks/coverage.py --out results/coverage        # about 10 minutes on one core

Every estimate begins at the truth, so that only the intervals are judged, not the search. Prints
how often the interval of 90 % holds the truth, for each parameter and for all.
"""

import argparse
import csv
from pathlib import Path

import jax
import measure
import numpy as np

from r2s import scenarios
from r2s.estimation.descent import DEFAULT, descend
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

NINETY = 1.645  # deviations to either side


def scores(name: str, scenario: str, number: int) -> np.ndarray:
    """The errors of an estimate, in its own deviations."""
    fabric = presets.FIVE[name]()
    space = OrthotropicSpace.make(float(fabric.density))
    experiment = scenarios.SIX[scenario]()
    recording = synthetic.record(experiment, fabric, name, key=jax.random.key(1000 + number))
    problem = Problem.make(recording, space, seed=number)
    start = space.to_unit(fabric)
    budget = DEFAULT._replace(coarse=0, starts=1)
    found = descend(problem, budget, start=start, key=jax.random.key(0))
    truth = np.asarray(space.values(start))
    log = np.array([bound.log for bound in space.ranges])
    ratio = np.where(log, found.values / np.where(log, truth, 1), 1)
    return np.where(log, np.log(ratio), found.values - truth) / found.standard_errors


def main(out: Path, scenario: str, each: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"coverage_{scenario}.csv"
    names = [bound.name for bound in OrthotropicSpace.make(0.2).ranges]
    rows = list(csv.reader(open(path)))[1:] if path.exists() else []
    for fabric in presets.FIVE:
        for number in range(each):
            if any(row[:2] == [fabric, str(number)] for row in rows):
                continue
            measure.progress(f"{scenario}, {fabric}, {number}")
            found = scores(fabric, scenario, number)
            rows.append([fabric, str(number), *(f"{z:.3f}" for z in found)])
            with open(path, "w", newline="") as file:
                csv.writer(file).writerows([["fabric", "number", *names], *rows])
    z = np.array([row[2:] for row in rows], float)
    lines = [
        {"name": name, "share": np.mean(np.abs(column) < NINETY), "spread": column.std()}
        for name, column in zip((*names, "all"), (*z.T, z.ravel()), strict=True)
    ]
    columns = {
        "parameter": lambda row: row["name"],
        "within 90 %": lambda row: f"{row['share']:.0%}",
        "spread of error / deviation": lambda row: f"{row['spread']:.2f}",
    }
    measure.show(f"{scenario}: {len(z)} recordings", lines, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Do intervals hold the truth?")
    parser.add_argument("--out", type=Path, default=Path("results/coverage"))
    parser.add_argument("--scenario", default="lifting", choices=("lifting", "wind", "stretching"))
    parser.add_argument("--each", type=int, default=10, help="recordings of each preset")
    a = parser.parse_args()
    main(a.out, a.scenario, a.each)
