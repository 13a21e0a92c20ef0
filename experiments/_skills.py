"""What an estimate from a configuration's recordings of a fabric predicts, and what it found.

All is predicted on the cloth, what was estimated on material points, too.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
from _tables import Line, made_by
from scipy.stats import norm

from r2s.estimation.estimate import Estimate
from r2s.materials.fabric import Fabric
from r2s.study import engine, results, verdicts
from r2s.study.configuration import MOTIONS, ON_CLOTH
from r2s.study.estimates import EstimateTask, read_estimate
from r2s.study.evaluations import EvaluationTask
from r2s.study.mujoco import FABRIC as FLEX
from r2s.study.plan import SMALL, configuration_named, synthetic
from r2s.study.recordings import strain_dependent
from r2s.study.tasks import read_metadata
from r2s.study.verdicts import SURFACE

JUDGED = ("fling", "shaking")
OUTSIDE = "*"  # behind a number whose 90 % interval does not hold the truth
NARROWED = 0.5  # of the prior standard deviation: what is below counts as determined
ESTIMATES = ("", ON_CLOTH)
NAMED = {name: "estimate" for name in ESTIMATES} | {
    "true": "true fabric",
    "middle": "middle",
    "default": "default",
}


def predicted(folder: Path, configuration: str, fabric: str, law: str) -> Line:
    """The line of a table: errors [mm] and skill in the first fling and shaking, numbers of the
    fabric over the truth's at small strain, how many of these the intervals hold, by how many
    standard errors what is narrowed to half of the prior is off, and the seconds of a CPU.

    `law`: "told" by the recordings, as in a study, or one of `r2s.estimation.default_spaces`.
    """
    cells = [_of_law(each, law) for each in _cells(configuration, fabric, JUDGED)]
    line = _errors(cells, folder)
    estimate = _estimate(cells)
    return line | _over_truth(estimate, folder) | _cost(estimate, folder)


def predicted_alone(folder: Path, configuration: str, fabric: str) -> Line:
    """The line of a table: errors [mm] and skill of an estimate in the first fling and shaking of a
    fabric, and the seconds of a CPU that it took."""
    return _judged(folder, _cells(configuration, fabric, JUDGED))


def predicted_elsewhere(folder: Path, configuration: str, repeat: str) -> Line:
    """As `predicted_alone`, in the first fold, fling and shaking of MuJoCo's sheet, of an estimate
    from its lift of that number."""
    return _judged(folder, _cells(configuration, FLEX, MOTIONS, int(repeat)))


def _judged(folder: Path, cells: list[EvaluationTask]) -> Line:
    return _errors(cells, folder) | _cost(_estimate(cells), folder)


def _estimate(cells: list[EvaluationTask]) -> EstimateTask:
    """The one that some cells evaluate."""
    (found,) = {cell.estimate for cell in cells if cell.estimate is not None}
    return found


def _cost(cell: EstimateTask, folder: Path) -> Line:
    return {"CPU s": f"{read_metadata(cell, folder)['cpu_seconds']:.0f}"}


def _cells(
    configuration: str, fabric: str, motions: Sequence[str], repeat: int = 0
) -> list[EvaluationTask]:
    plan = replace(
        SMALL,
        configurations=(configuration_named(configuration),),
        fabrics=(fabric,),
        repeats=repeat + 1,
        judged=1,
        every=1,
        draws=4,
    )
    return [
        cell
        for cell in synthetic(plan)
        if cell.scenario in motions
        and cell.solver == "cloth"
        and (cell.estimate is None or cell.estimate.repeat == repeat)
    ]


def _errors(cells: list[EvaluationTask], folder: Path) -> Line:
    """Make some cells, and say what rows they give: by motion floor, errors and skill."""
    failed = engine.run([*verdicts.ensembles(cells), *cells], folder, engine.Serial())
    if failed:
        raise RuntimeError(next(iter(failed.values())))
    found = results.collect(cells, folder)
    found = found[found.metric == SURFACE]
    line: Line = {}
    for motion in dict.fromkeys(cell.scenario for cell in cells):
        line |= _of(motion, found[found.evaluated_on == motion])
    return line | made_by([*verdicts.ensembles(cells), *cells], folder)


def _of_law(cell: EvaluationTask, law: str) -> EvaluationTask:
    if cell.estimate is None or law == "told":
        return cell
    return replace(cell, estimate=replace(cell.estimate, law=law))


def _of(motion: str, rows: pd.DataFrame) -> Line:
    found: Line = {f"{motion}: floor": _millimetres(rows.floor.iloc[0])}
    for baseline, name in NAMED.items():
        values = rows[rows.baseline == baseline].value
        if len(values):  # another simulator's sheet has no true fabric
            found[f"{motion}: {name}"] = _millimetres(values.mean(skipna=False))
    (skill,) = set(rows[rows.baseline.isin(ESTIMATES)].skill)
    return found | {f"{motion}: skill": "not told" if np.isnan(skill) else f"{skill:.2f}"}


def repeated(folder: Path, configuration: str, fabric: str, repeat: str) -> Line:
    """The line of a table: how an estimate from the recordings of that number stands to the truth,
    by parameter in its standard errors, in brackets what is not narrowed to half, and by how
    much the rest is off at most."""
    cells = _cells(configuration, fabric, JUDGED, int(repeat))
    cell = _estimate([_of_law(each, "told") for each in cells])
    if failed := engine.run([cell], folder, engine.Serial()):
        raise RuntimeError(next(iter(failed.values())))
    found = read_estimate(cell, folder)
    if found is None:
        return {"converged": "diverged"}
    off, away = _off(cell, found)
    line: Line = {}
    for bound, errors, is_known in zip(found.ranges, away, found.narrowing < NARROWED, strict=True):
        line[bound.name] = f"{errors:+.2f}" if is_known else f"({errors:+.2f})"
    known = np.abs(off[found.narrowing < NARROWED])
    return line | {
        "narrowed off at most": f"{known.max():.3f}" if len(known) else "-",
        "converged": "yes" if found.converged else "no",
        "recordings agree": _agreement(found, cell),
    }


def _off(cell: EstimateTask, found: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """How far an estimate is from the truth, by parameter: in shares of it (the coupling as it is),
    and in standard errors, both as in the range."""
    true = results.true_values(cell, found.ranges)
    rows = zip(found.ranges, found.values, true, strict=True)
    off = np.array([np.log(v / there) if bound.log else v - there for bound, v, there in rows])
    return off, off / found.standard_errors


def _over_truth(cell: EstimateTask, folder: Path) -> Line:
    found = read_estimate(cell, folder)
    if found is None:
        return {"warp": "diverged"}
    off, away = _off(cell, found)
    away = np.abs(away)
    line: Line = {}
    for bound, apart, errors in zip(found.ranges, off, away, strict=True):
        number = f"{np.exp(apart):.2f}" if bound.log else f"{apart:+.2f}"
        line[bound.name] = number + OUTSIDE * bool(errors >= norm.ppf(0.95))
    known = away[found.narrowing < NARROWED]
    fabric = strain_dependent(cell.fabric)
    for name, axis in (("warp", 0), ("weft", 1)):
        grown = [f"{_growth(each, axis):.1%}" for each in (found.fabric, fabric)]
        line[f"growth of {name} (truth)"] = f"{grown[0]} ({grown[1]})"
    return line | {
        "converged": "yes" if found.converged else "no",
        "left out": ", ".join(f"{fit.outliers:.0%}" for fit in found.fits),
        "recordings agree": _agreement(found, cell),
        "in 90 % intervals": f"{np.sum(away < norm.ppf(0.95))} of {len(away)}",
        "narrowed": f"{len(known)}",
        "errors off at most": f"{known.max():.1f}" if len(known) else "-",
    }


def _growth(fabric: Fabric, axis: int) -> float:
    """By how much the energy of a 5 % stretch exceeds that of constant stiffness, [-]."""
    strain = jnp.zeros(3).at[axis].set((1.05**2 - 1) / 2)
    small = getattr(fabric.membrane, "small", fabric.membrane)
    return float(fabric.membrane.energy_density(strain) / small.energy_density(strain)) - 1


def _agreement(found: Estimate, cell: EstimateTask) -> str:
    """Whether the recordings do, by the likelihood by chance; else which does not."""
    if found.agreement is None:
        return "not judged"
    odd = found.agreement.contradiction
    if odd is None:
        return f"yes, {found.agreement.p:.2g}"
    return f"no, {found.agreement.p:.1g}: {cell.sources[odd.recording].name}, {odd.parameter}"


def _millimetres(value: float) -> str:
    return "-" if np.isnan(value) else f"{1e3 * value:.1f}"
