"""Where the cloth is held against the commanded path, in real folds: which offset and lag fit best.

python benchmarks/calibration.py --data FOLDER --out results/calibration   # 10 minutes on one core

The recordings state neither the camera's pose nor how the fingers hold the sheet. Six assumed
fabrics (the default and the presets; none is estimated) move along the commanded path with every
offset [m] and lag [s] of a grid, the same for all recordings. Printed: the mean error from the
recordings to the simulations, for every offset and its best lag; and the choice that a recording's
error would be judged with, had it been made on the other fabrics alone.
"""

import argparse
import itertools
from pathlib import Path

import equinox as eqx
import measure
import numpy as np

from r2s.evaluation import prediction_error
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.files import write_json
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, subsample

METRIC, FOLD = "chamfer_real_to_sim", "fold"
BACK = (0.01, 0.0, -0.01, -0.02, -0.03)  # [m], along y
BELOW = (0.0, -0.012, -0.025)  # [m], along z
LAGS = (0.0, 0.06, 0.12, 0.18)  # [s]
EVERY, POINTS = 3, 300  # frames, and points of each that are compared


def moved(recording: Recording, change: np.ndarray, lag: float) -> Recording:
    """The recording with its sheet held elsewhere than written down, and another lag."""
    path = recording.handle_path + np.asarray(change, recording.handle_path.dtype)
    times = recording.times + np.asarray(-lag - recording.info.time_offset, recording.times.dtype)
    return eqx.tree_at(lambda r: (r.handle_path, r.times), recording, (path, times))


def errors(recordings: list[Recording], fabrics: list, change: np.ndarray, lag: float) -> list:
    """Mean error [m] of the fabrics on every recording."""
    at = [moved(recording, change, lag) for recording in recordings]
    motions = [
        prediction_error.predict(at[0], fabric) for fabric in fabrics
    ]  # one path for all of them
    score = lambda r: np.mean(
        [prediction_error.against_motion(r, x, EVERY, crop=False)[METRIC] for x in motions]
    )
    return [float(score(recording)) for recording in at]


def main(folder: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rules = manifest.manifest_for(folder)
    names = manifest.read_recordings(folder, rules, (FOLD,))
    read = lambda name: subsample(manifest.read_recording(folder, rules, name), POINTS, None, 0)
    recordings = [read(name) for name in names]
    written = np.array(rules.scenarios[FOLD].gripper.offset)
    fabrics = [OrthotropicSpace.make(0.15).middle(), *(make() for make in presets.FIVE.values())]
    rows = []
    for y, z, lag in itertools.product(BACK, BELOW, LAGS):
        measure.progress(f"y {1e3 * y:.0f} mm, z {1e3 * z:.0f} mm, lag {1e3 * lag:.0f} ms")
        found = errors(recordings, fabrics, np.array([0, y, z]) - written, lag)
        rows.append({"y": y, "z": z, "lag": lag, "errors": found})
        write_json(out / f"{FOLD}.json", rows)
    summary(rows, recordings)


def summary(rows: list[measure.Row], recordings: list[Recording]) -> None:
    """The best lag of every offset, on all recordings; then what the other fabrics would choose."""
    best = {}
    for row in rows:
        place = row["y"], row["z"]
        if place not in best or np.mean(row["errors"]) < np.mean(best[place]["errors"]):
            best[place] = row
    columns = {
        "y [mm]": lambda row: f"{1e3 * row['y']:.0f}",
        "z [mm]": lambda row: f"{1e3 * row['z']:.0f}",
        "lag [ms]": lambda row: f"{1e3 * row['lag']:.0f}",
        "error [mm]": lambda row: f"{1e3 * np.mean(row['errors']):.2f}",
    }
    order = sorted(best.values(), key=lambda row: np.mean(row["errors"]))
    measure.show("assumed fabrics on all recordings", order, columns)
    lines = []
    for name in dict.fromkeys(recording.info.fabric for recording in recordings):
        own = np.array([recording.info.fabric == name for recording in recordings])
        choice = min(rows, key=lambda row: np.mean(np.array(row["errors"])[~own]))
        lines.append(choice | {"fabric": name, "errors": np.array(choice["errors"])[own]})
    measure.show(
        "chosen on the other fabrics", lines, {"fabric": lambda row: row["fabric"]} | columns
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Offset and lag of the cloth in real folds.")
    parser.add_argument("--data", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=Path("results/calibration"))
    a = parser.parse_args()
    main(a.data, a.out)
