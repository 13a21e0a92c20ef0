"""Where was the cloth held, against the commanded path? The offset and lag that fit real folds.

python experiments/grip_offset.py recordings      # 10 minutes on one core

The recordings state neither the camera's pose nor how the fingers hold the sheet. Assumed fabrics
(the default and the presets; none is estimated) move along the commanded path with every offset
[mm] and lag [ms] of a grid, the same for all recordings. Printed, for each, best first: the mean
error [mm] from the recordings to the simulations.
"""

import itertools
from pathlib import Path

import equinox as eqx
import numpy as np
from _common import recordings_in
from _tables import Line, command_line, keep

import r2s
from r2s.evaluation import prediction_error
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, subsample

BACK, BELOW = (-10, 0, 10, 20, 30), (0, -12, -25)  # [mm], along x and z
LAGS = (0, 60, 120, 180)  # [ms]
EVERY, POINTS = 3, 300  # frames, and points of each that are compared


def held(recording: Recording, offset: np.ndarray, lag: float) -> Recording:
    """The recording with its sheet held elsewhere [m] and its clock later [s] than written down."""
    path = recording.handle_path + offset.astype(recording.handle_path.dtype)
    times = recording.times - np.float32(lag + recording.info.time_offset)
    return eqx.tree_at(lambda r: (r.handle_path, r.times), recording, (path, times))


def error(recordings: list[Recording], fabrics: list[Fabric]) -> float:
    """Mean error [mm] of the fabrics on recordings of one path."""
    motions = [prediction_error.predict(recordings[0], fabric) for fabric in fabrics]
    pairs = itertools.product(recordings, motions)
    found = [prediction_error.against_motion(r, x, EVERY, crop=False) for r, x in pairs]
    return 1e3 * float(np.mean([each["chamfer_real_to_sim"] for each in found]))


if __name__ == "__main__":
    parser = command_line(__doc__, "results/grip_offset.csv")
    parser.add_argument("recordings", type=Path)
    a = parser.parse_args()
    folds = [subsample(r, POINTS, None, 0) for r in recordings_in(a.recordings, "fold")]
    written = np.array(manifest.manifest_for(a.recordings).scenarios["fold"].gripper.offset)
    default = r2s.OrthotropicSpace.make(0.15).middle()
    fabrics = [default, *(make() for make in presets.FIVE.values())]
    lines: list[Line] = []
    for x, z, lag in itertools.product(BACK, BELOW, LAGS):
        moved = [held(r, np.array([x, 0, z]) / 1e3 - written, lag / 1e3) for r in folds]
        names = {"x [mm]": f"{x}", "z [mm]": f"{z}", "lag [ms]": f"{lag}"}
        lines.append(names | {"error [mm]": f"{error(moved, fabrics):.2f}"})
    lines.sort(key=lambda line: float(line["error [mm]"]))
    keep(a.out, lines, "Assumed fabrics on all real folds, by where the cloth is held.")
