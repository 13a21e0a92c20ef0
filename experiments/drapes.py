"""Drape coefficients of the five fabrics: over folds that start otherwise, and on finer meshes.

python experiments/drapes.py      # 6 minutes on one core

Each fabric's specimen is simulated from several seeds on the usual ring, and from one on a ring of
a third and of four times as many cells (vertices around x cells across). Also by how much the
coefficient changes with bending and with shear, for a relative change, as its derivative says.
"""

import jax.numpy as jnp
import numpy as np
from _laboratory import drapes_at, slopes
from _tables import Line, command_line, keep

from r2s.fabrics import presets
from r2s.laboratory.drape import ring

SEEDS = 8
COARSE, FINE = (44, 6), (144, 20)


if __name__ == "__main__":
    a = command_line(__doc__, "results/drapes.csv").parse_args()
    usual, coarse, fine = ring(), ring(shape=COARSE), ring(shape=FINE)
    lines: list[Line] = []
    for name in presets.FIVE:
        fabric = presets.MEASURED[name]()
        found = [float(drapes_at(usual, fabric, jnp.asarray(seed))) for seed in range(SEEDS)]
        bending, shear = slopes(usual, fabric)
        row = {"mean": np.mean(found), "deviation over seeds": np.std(found, ddof=1)}
        row |= {
            f"{shape[0]} x {shape[1]}": float(drapes_at(each, fabric, jnp.asarray(0)))
            for shape, each in ((COARSE, coarse), (FINE, fine))
        }
        row |= {"per bending": float(bending), "per shear": float(shear)}
        lines.append({"fabric": name} | {key: f"{value:.3f}" for key, value in row.items()})
        keep(a.out, lines, "Drape coefficients, 0.30 m discs on 0.18 m [-].")
