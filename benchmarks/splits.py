"""Real recordings, split in three ways, and what the model could reach at all.

python benchmarks/splits.py --data FOLDER --out results/splits     # about 10 minutes on one core

Every lift and fold of a folder gets its estimate, and every estimate predicts all recordings of
its fabric. Printed, as the mean error from the recording to the simulation: estimates from a lift
judged on the fold of the same trial; on that of another trial; from a fold judged on a lift; beside
them the default fabric, another trial's recording (the repeatability floor), and the estimate from
the judged recording itself, which is the best that the model can do there.

What is estimated is kept, and not made again.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import jax
import measure
import numpy as np

from r2s import manifest
from r2s.estimators import diffcloud
from r2s.estimators.estimate import Estimate, as_json, from_json
from r2s.estimators.problem import Problem
from r2s.fabric import Fabric
from r2s.family import OrthotropicFamily
from r2s.files import write_json
from r2s.recording import Recording
from r2s.study import judge

METRIC = "chamfer_real_to_sim"
LIFT, FOLD = "lift", "fold"


def estimate_of(recording: Recording, density: float, out: Path) -> Estimate:
    """The default estimate from one recording, read where it is there."""
    path = out / f"{recording.info.name}.json"
    if path.exists():
        return from_json(json.loads(path.read_text()))
    measure.progress(f"estimate from {recording.info.name}")
    problem = Problem.make(recording, OrthotropicFamily.make(density))
    found = diffcloud.estimate(problem, key=jax.random.key(0))
    write_json(path, as_json(found))
    return found


def error(recording: Recording, fabric: Fabric) -> float:
    """Mean distance [m] from a recording to a fabric's motion."""
    return judge.against_motion(recording, judge.predict(recording, fabric))[METRIC]


def rows_of(
    judged: Recording, all_of_it: Sequence[Recording], estimates: dict[str, Estimate], default
) -> list[measure.Row]:
    """The errors [m] on one recording: of every estimate of its fabric, and beside them."""
    info = judged.info
    about = {"fabric": info.fabric, "judged on": info.name}
    row = lambda split, value: about | {"split": split, "error": value}
    found = [row("default fabric", error(judged, default))]
    for other in all_of_it:
        name, same = other.info.name, other.info.trial == info.trial
        value = error(judged, estimates[name].fabric)
        if name == info.name:
            found.append(row("itself", value))
        elif other.info.scenario != info.scenario:
            trial = "same trial" if same else "other trial"
            found.append(row(f"{other.info.scenario} to {info.scenario}, {trial}", value))
        else:
            found.append(row(f"{info.scenario} to {info.scenario}, other trial", value))
            floor = judge.against_recording(judged, other)[METRIC]
            found.append(row("other trial's recording", floor))
    return found


def main(folder: Path, out: Path, density: float) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rules = manifest.manifest_for(folder)
    recordings = manifest.read_recordings(folder, rules, (LIFT, FOLD))
    loaded = [manifest.read_recording(folder, rules, name) for name in recordings]
    estimates = {r.info.name: estimate_of(r, density, out) for r in loaded}
    default = OrthotropicFamily.make(density).middle()
    rows = []
    for judged in loaded:
        measure.progress(f"errors on {judged.info.name}")
        same = [r for r in loaded if r.info.fabric == judged.info.fabric]
        rows += rows_of(judged, same, estimates, default)
        write_json(out / "errors.json", rows)
    summary(rows)


def summary(rows: Sequence[measure.Row]) -> None:
    """A line for each way to split and kind of motion; then one for each recording."""
    for kind in (FOLD, LIFT):
        of_kind = [r for r in rows if r["judged on"].startswith(kind)]
        splits = list(dict.fromkeys(r["split"] for r in of_kind))
        names = list(dict.fromkeys(r["judged on"] for r in of_kind))
        value = {
            (s, n): np.mean([r["error"] for r in of_kind if (r["split"], r["judged on"]) == (s, n)])
            for s in splits
            for n in names
        }
        lines = [{"on": n, **{s: value[s, n] for s in splits}} for n in names]
        lines.append({"on": "mean", **{s: np.mean([value[s, n] for n in names]) for s in splits}})
        columns = {f"{kind}, mm": lambda row: row["on"]}
        for s in splits:
            columns[s] = lambda row, s=s: f"{1e3 * row[s]:.1f}"
        measure.show(f"error on each {kind}", lines, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimates judged on other recordings.")
    parser.add_argument("--data", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=Path("results/splits"))
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    main(a.data, a.out, a.density)
