"""Draw what `mesh_error.py` measured for each fabric: error over the length of the cells.

python experiments/mesh_error_picture.py docs/results/mesh_error_by_fabric.csv

One panel a motion: distances from the finest mesh by cell / fold length, one line a fabric; broken,
the errors that `r2s.scenarios.resolution` expects, to which that of the finest mesh belongs.
"""

from pathlib import Path

import matplotlib
import numpy as np
from _tables import command_line, read

from r2s import fold_length
from r2s.fabrics import presets
from r2s.scenarios.resolution import ENOUGH, TABLE
from r2s.scenarios.six import SIDE

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

if __name__ == "__main__":
    parser = command_line(__doc__, "docs/mesh_error.png")
    parser.add_argument("table", type=Path)
    a = parser.parse_args()
    lines, _ = read(a.table)
    figure, axes = plt.subplots(2, 3, figsize=(9, 5.4), sharex=True, sharey=True, layout="tight")
    for axis, (motion, expected) in zip(axes.ravel(), TABLE.items(), strict=True):
        for line in (each for each in lines if each["motion"] == motion):
            length = float(fold_length(presets.FIVE[line["fabric"]]()))
            sizes = [int(name) for name in line if name.isdigit() and float(line[name]) > 0]
            ratios = [SIDE / (size - 1) / length for size in sizes]
            label = line["fabric"].replace("_", " ")
            axis.plot(ratios, [float(line[str(size)]) for size in sizes], "o-", label=label)
        axis.plot(*(np.array(expected).T * [[1], [1e3]]), "k--", label="expected")
        axis.axhline(1e3 * ENOUGH, color="0.7", linewidth=0.8)
        axis.set(title=motion, xscale="log", yscale="log")
    axes[0, 0].legend(fontsize=6)
    figure.supxlabel("cell / fold length [-]")
    figure.supylabel("distance [mm]")
    figure.savefig(a.out, dpi=80)
