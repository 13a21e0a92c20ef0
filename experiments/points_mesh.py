"""Which mesh do material points need to show what a fabric does?

python experiments/points_mesh.py --out docs/results/points_mesh.csv      # a quarter of an hour

The true fabric at small strain, predicted by material points on meshes of several sizes, in
motions of a study's truths: mean distance of the recorded points from the surface over the whole
motion, and over its quarters, beside that of the cloth on 33 x 33 vertices.
"""

import time
from pathlib import Path

import numpy as np
from _tables import Line, command_line, resumed

from r2s.evaluation import prediction_error
from r2s.fabrics import presets
from r2s.study import engine
from r2s.study.evaluations import SHAPES, predict
from r2s.study.sources import SyntheticRecording, read, read_start, small_strain

CAPTION = (
    "True fabric at small strain: mean distance [mm] of the recorded points, over the motion and "
    "over its quarters."
)


def line(folder: Path, motion: str, fabric: str, solver: str, shape: str) -> Line:
    """The line of a table."""
    source = SyntheticRecording(fabric, motion, 0, True)
    if failed := engine.run([source], folder, engine.Serial()):
        raise RuntimeError(f"{motion} of {fabric}: {next(iter(failed.values()))}")
    recording, start = read(source, folder), read_start(source, folder)
    mesh, began = (int(shape), int(shape)), time.process_time()
    (moved,) = predict([recording], small_strain(fabric), solver, [start], mesh)
    away = 1e3 * prediction_error.from_surface(recording, moved.x, mesh)
    return {
        "mean": f"{away.mean():.2f}",
        "by quarter": ", ".join(f"{each.mean():.1f}" for each in np.array_split(away, 4)),
        "CPU s, with compilation": f"{time.process_time() - began:.0f}",
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/points_mesh.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=["camel_ponte_roma"])
    parser.add_argument("--motions", nargs="+", default=["fling", "shaking"])
    parser.add_argument("--shapes", nargs="+", default=["9", "17", "25", "33"])
    parser.add_argument("--folder", type=Path, default=Path("results/points_mesh"), help="of cells")
    a = parser.parse_args()
    solvers = [("points", each) for each in a.shapes] + [("cloth", str(SHAPES["cloth"][0]))]
    jobs: list[Line] = [
        {"motion": motion, "fabric": fabric, "solver": solver, "shape": shape}
        for motion in a.motions
        for fabric in a.fabrics
        for solver, shape in solvers
    ]
    resumed(a.out, CAPTION, jobs, lambda **job: line(a.folder, **job))
