"""Real recordings, split in three ways, and what the model could reach at all.

python benchmarks/splits.py --data FOLDER --out results/splits     # about 20 minutes on one core

Every lift and fold of a folder gets its estimate, and every estimate predicts all recordings of
its fabric. Printed, as the mean error from the recording to the simulation: estimates from a lift
judged on the fold of the same trial; on that of another trial; from a fold judged on a lift; beside
them the default fabric, another trial's recording (the repeatability floor), other fabrics'
estimates, and the estimate from the judged recording itself, the best that the model can do there.
Then the same with the judged recording placed, for each of them, where it lies nearest: what is
left then is not the cameras'.

What is estimated is kept, and not made again.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import measure
import numpy as np
from scipy.spatial import KDTree

from r2s.estimation.descent import descend
from r2s.estimation.estimate import Estimate
from r2s.estimation.estimate_json import as_json, from_json
from r2s.estimation.problem import Problem
from r2s.evaluation import placement, prediction_error
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.files import write_json
from r2s.geometry.surface import sample
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, cloud
from r2s.scenarios.scenario import from_recording

LIFT, FOLD = "lift", "fold"


def estimate_of(recording: Recording, density: float, out: Path) -> Estimate:
    """The default estimate from one recording, read where it is there."""
    path = out / f"{recording.info.name}.json"
    if path.exists():
        return from_json(json.loads(path.read_text()))
    measure.progress(f"estimate from {recording.info.name}")
    problem = Problem.make(recording, OrthotropicSpace.make(density))
    found = descend(problem, key=jax.random.key(0))
    write_json(path, as_json(found))
    return found


def errors(real: list[np.ndarray], other: list[np.ndarray]) -> tuple[float, float]:
    """Mean distance [m] from a recording's frames to other points: as they are, and placed."""
    place = placement.nearest(real, other)
    mean = lambda clouds: float(np.mean([KDTree(b).query(a)[0].mean() for a, b in clouds]))
    there = [placement.moved(place, cloud) for cloud in real]
    return mean(zip(real, other, strict=True)), mean(zip(there, other, strict=True))


def points_of(recording: Recording, fabric: Fabric) -> list[np.ndarray]:
    """Points on a fabric's motion in the frames that count."""
    x, faces = (
        prediction_error.predict(recording, fabric),
        from_recording(recording).scene.mesh.faces,
    )
    return [
        np.asarray(sample(jnp.asarray(x[f]), faces, prediction_error.SAMPLES))
        for f in used(recording)
    ]


def used(recording: Recording) -> range:
    """The frames that count."""
    first, last = recording.info.frames_used
    return range(first, last + 1)


def rows_of(
    judged: Recording, loaded: Sequence[Recording], estimates: dict[str, Estimate], default
) -> list[measure.Row]:
    """The errors [m] on one recording: of every estimate of its fabric, and beside them."""
    info = judged.info
    about = {"fabric": info.fabric, "judged on": info.name}
    real = [cloud(judged, frame) for frame in used(judged)]

    def row(split: str, other: Fabric | Recording) -> measure.Row:
        if isinstance(other, Recording):
            points = [cloud(other, frame) for frame in used(judged)]
        else:
            points = points_of(judged, other)
        plain, placed = errors(real, points)
        return about | {"split": split, "error": plain, "placed": placed}

    found = [row("default fabric", default)]
    for other in loaded:
        name, same = other.info.name, other.info.trial == info.trial
        moves = f"{other.info.scenario} to {info.scenario}"
        if name == info.name:
            found.append(row("itself", estimates[name].fabric))
        elif other.info.fabric != info.fabric:
            if same and other.info.scenario != info.scenario:
                found.append(row(f"{moves}, other fabrics", estimates[name].fabric))
        elif other.info.scenario != info.scenario:
            trial = "same trial" if same else "other trial"
            found.append(row(f"{moves}, {trial}", estimates[name].fabric))
        else:
            found.append(row(f"{moves}, other trial", estimates[name].fabric))
            found.append(row("other trial's recording", other))
    return found


def main(folder: Path, out: Path, density: float) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rules = manifest.manifest_for(folder)
    recordings = manifest.read_recordings(folder, rules, (LIFT, FOLD))
    loaded = [manifest.read_recording(folder, rules, name) for name in recordings]
    estimates = {r.info.name: estimate_of(r, density, out) for r in loaded}
    default = OrthotropicSpace.make(density).middle()
    rows = []
    for judged in loaded:
        measure.progress(f"errors on {judged.info.name}")
        rows += rows_of(judged, loaded, estimates, default)
        write_json(out / "errors.json", rows)
    for which in ("error", "placed"):
        summary(rows, which)


def summary(rows: Sequence[measure.Row], which: str) -> None:
    """For each kind of motion a line for each recording, and their mean."""
    for kind in (FOLD, LIFT):
        of_kind = [r for r in rows if r["judged on"].startswith(kind)]
        splits = list(dict.fromkeys(r["split"] for r in of_kind))
        names = list(dict.fromkeys(r["judged on"] for r in of_kind))
        value = {
            (s, n): np.mean([r[which] for r in of_kind if (r["split"], r["judged on"]) == (s, n)])
            for s in splits
            for n in names
        }
        lines = [{"on": n, **{s: value[s, n] for s in splits}} for n in names]
        lines.append({"on": "mean", **{s: np.mean([value[s, n] for n in names]) for s in splits}})
        columns = {f"{kind}, mm": lambda row: row["on"]}
        for s in splits:
            columns[s] = lambda row, s=s: f"{1e3 * row[s]:.1f}"
        measure.show(f"{which} on each {kind}", lines, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimates judged on other recordings.")
    parser.add_argument("--data", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=Path("results/splits"))
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    a = parser.parse_args()
    main(a.data, a.out, a.density)
