"""The uniaxial pulls of knits of stitch-by-stitch (Singal et al., Nature Communications 15, 2024).

Article 2622; repository sabetta/stitch-by-stitch (MIT licence), commit 0ed27f35, files
`data/uniaxial_experiments/experimentData/outputData_{yarn} {stitch} {X,Y}.h5`: force [N] and
tracked pins [pixel] of five pulls of a swatch. X is along the courses (rows), Y along the wales.
Its notebook has what the files lack: the clamp that gives the scale is 35.5 mm wide, strain counts
from the first frame of the second pull, and the first pull, of a swatch that was never stretched,
is left out. The fabrics' weight is not given. Needs h5py: pip install 'r2s[laboratory]'.
"""

from pathlib import Path

import numpy as np

from r2s._util.extras import require
from r2s.laboratory.pull import SPECIMEN, Pull

CLAMP = 0.0355  # [m]
REFERENCE = "video2"  # whose first frame has the length at rest
PULLS = ("video2", "video3", "video4", "video5")
RIGHT, LEFT, LOWER, UPPER = 0, 1, -2, -1  # of the tracked pins; the last two are the clamps'


def read_knit(path: Path | str, direction: float, specimen: float = SPECIMEN) -> list[Pull]:
    """The pulls of one file, but for the first.

    `direction`: of the pull from the warp, [rad]; of knits the warp is taken along the wales, so
    that it is 0 for Y and pi/2 for X. `specimen`: see `Pull`.

    Raises FileNotFoundError; ValueError that names the file and the pull: no such file of HDF5,
    arrays that are missing or of other shapes; ImportError that names the extra.
    """
    path = Path(path)
    h5py = require("h5py", "laboratory", "the pulls of stitch-by-stitch")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            arrays = {
                name: tuple(np.asarray(file[name][key], float) for key in ("traj", "forces"))
                for name in PULLS
            }
            clamp, fabric = (float(file[key][0]) for key in ("clampSize", "fabricSize"))
        if not min(clamp, fabric) > 0:
            raise ValueError(f"sizes must be positive, found {clamp} and {fabric}")
    except Exception as error:  # a file of another layout raises anything
        raise ValueError(f"{path}: no pulls of stitch-by-stitch: {error}") from error
    scale, spans = CLAMP / clamp, {}  # [m] a pixel
    for name, (pins, force) in arrays.items():
        if pins.ndim != 3 or pins.shape[0] < 4 or pins.shape[1:] != (2, len(force)):
            raise ValueError(
                f"{path}: {name}: expected pins (four or more, 2, {len(force)}), found {pins.shape}"
            )
        along, across = pins[UPPER] - pins[LOWER], pins[RIGHT] - pins[LEFT]
        spans[name] = np.linalg.norm([along, across], axis=1)  # between clamps, between the sides
    length, wide = spans[REFERENCE][:, 0]
    size = float(length * scale), fabric * scale
    return [
        Pull.make(
            (spans[name][0] - length) * scale,
            force,
            size,
            direction,
            spans[name][1] / wide * size[1],
            specimen,
            f"{path.name}: {name}",
        )
        for name, (_, force) in arrays.items()
    ]
