"""How well is each judged motion known, and does the true fabric beat knowing nothing in it?

python experiments/floors.py --out docs/results/floors.csv      # hours for five fabrics

For every preset and motion: the floor of the truth's ensemble and its horizon; what fabrics differ
by; the mean error up to the horizon of the true fabric at small strain (what a perfect estimate
would reach), and of the draws of the prior that are a study's default, with their range. All errors
are distances from the truth's points to the surface of the cloth that a study predicts with.
"""

from pathlib import Path

import numpy as np
from _tables import Line, command_line, resumed

from r2s.fabrics import presets
from r2s.study import engine, results, verdicts
from r2s.study.configuration import MOTIONS
from r2s.study.ensembles import read_ensemble
from r2s.study.evaluations import EvaluationCell
from r2s.study.matrix import DRAWS
from r2s.study.rows import Row
from r2s.study.sources import SyntheticRecording, small_strain
from r2s.study.verdicts import SURFACE

CAPTION = (
    "Mean distances [mm] up to the horizon: floor of the truth, true fabric at small strain, "
    "default (mean of draws of the prior, least to most); what fabrics differ by."
)


def line(folder: Path, motion: str, fabric: str, number: str) -> Line:
    """The line of a table."""
    source = SyntheticRecording(fabric, motion, int(number), True)
    density = float(small_strain(fabric).density)
    draws = (None, *range(DRAWS))
    cells = [EvaluationCell(None, "cloth", density, fabric, (source,), each) for each in draws]
    ensembles = verdicts.ensembles(cells)
    failed = engine.run([*ensembles, *cells], folder, engine.Serial())
    if failed:
        raise RuntimeError(f"{motion} of {fabric}: {next(iter(failed.values()))}")
    found = [row for row in results.rows(cells, folder) if row.metric == SURFACE]
    (true,) = (row for row in found if row.baseline == "true")
    drawn = np.array([row.value for row in found if row.baseline == "default"])
    ensemble = read_ensemble(ensembles[0], folder)
    means = {cause: 1e3 * each.mean() for cause, each in ensemble.causes.items()}
    between = 1e3 * np.mean(np.sqrt(np.mean(ensemble.apart**2, axis=1)))
    return {
        "horizon [s]": _number(true.horizon),
        "between fabrics": f"{between:.1f}",
        **{f"floor: {cause}": f"{value:.2f}" for cause, value in means.items()},
        "floor": _millimetres(true.floor),
        "true fabric": _millimetres(true.value),
        "default": f"{1e3 * drawn.mean():.1f} ({1e3 * drawn.min():.1f} to {1e3 * drawn.max():.1f})",
        "skill of the true fabric": _skill(true),
    }


def _number(value: float | None) -> str:
    return "-" if value is None else "never" if np.isinf(value) else f"{value:.2f}"


def _millimetres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def _skill(row: Row) -> str:
    return "not told" if row.skill is None else f"{row.skill:.2f}"


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/floors.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--numbers", nargs="+", default=["0"], help="of the motions")
    parser.add_argument("--folder", type=Path, default=Path("results/floors"), help="of cells")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"motion": motion, "fabric": fabric, "number": number}
        for fabric in a.fabrics
        for motion in a.motions
        for number in a.numbers
    ]
    resumed(a.out, CAPTION, jobs, lambda **job: line(a.folder, **job))
