"""How well a judged motion is known, beside the true fabric's error in it and the default's."""

from pathlib import Path

import numpy as np
from _tables import Line, made_by

from r2s.study import engine, results, verdicts
from r2s.study.ensembles import read_ensemble
from r2s.study.evaluations import EvaluationCell
from r2s.study.matrix import DRAWS
from r2s.study.sources import SyntheticRecording, small_strain
from r2s.study.verdicts import SURFACE


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
    found = results.collect(cells, folder)
    found = found[found.metric == SURFACE]
    (true,) = found[found.baseline == "true"].itertuples()
    drawn = found[found.baseline == "default"].value.to_numpy()
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
        "skill of the true fabric": "not told" if np.isnan(true.skill) else f"{true.skill:.2f}",
    } | made_by(cells, folder)


def _number(value: float) -> str:
    return "-" if np.isnan(value) else "never" if np.isinf(value) else f"{value:.2f}"


def _millimetres(value: float) -> str:
    return "-" if np.isnan(value) else f"{1e3 * value:.2f}"
