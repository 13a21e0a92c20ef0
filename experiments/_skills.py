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
from r2s.study import engine, results
from r2s.study.configuration import ON_CLOTH
from r2s.study.ensembles import SURFACE, ensembles
from r2s.study.estimates import EstimateTask, read_estimate
from r2s.study.evaluations import EvaluationTask
from r2s.study.plan import SMALL, configuration_named, synthetic
from r2s.study.recordings import strain_dependent
from r2s.study.tasks import Task, read_metadata

JUDGED = ("fling", "shaking")
OUTSIDE = "*"  # behind a number whose 90 % interval does not hold the truth
NARROWED = 0.5  # of the prior standard deviation: what is below counts as determined
ESTIMATES = ("", ON_CLOTH)
NAMED = {name: "estimate" for name in ESTIMATES} | {
    "true": "true fabric",
    "middle": "prior mean",
    "default": "prior samples",
}


def predicted(folder: Path, configuration: str, fabric: str, law: str) -> Line:
    """The line of a table: errors [mm] and skill in the first fling and shaking, numbers of the
    fabric over the truth's at small strain, how many of these the intervals hold, by how many
    standard errors what is narrowed to half of the prior is off, and the seconds of a CPU.

    `law`: "identified" by the recordings, as in a study, or one of `r2s.estimation.default_spaces`.
    """
    tasks, estimate = _tasks(configuration, fabric)
    if law != "identified":
        estimate = replace(estimate, law=law)
        tasks = [
            task if task.estimate is None else replace(task, estimate=estimate) for task in tasks
        ]
    return _errors(tasks, folder) | _over_truth(estimate, folder) | _cost(estimate, folder)


def predicted_alone(
    folder: Path,
    configuration: str,
    fabric: str,
    repeat: str = "0",
    motions: Sequence[str] = JUDGED,
) -> Line:
    """The line of a table: errors [mm] and skill of an estimate from the recordings of that number
    in the first motions of a fabric, and the seconds of a CPU that it took."""
    tasks, estimate = _tasks(configuration, fabric, int(repeat), motions)
    return _errors(tasks, folder) | _cost(estimate, folder)


def _cost(estimate: EstimateTask, folder: Path) -> Line:
    return {"CPU s": f"{read_metadata(estimate, folder)['cpu_seconds']:.0f}"}


def _tasks(
    configuration: str, fabric: str, repeat: int = 0, motions: Sequence[str] = JUDGED
) -> tuple[list[EvaluationTask], EstimateTask]:
    """The evaluations of an estimate and of its references on the cloth, and the estimate."""
    plan = replace(
        SMALL,
        configurations=(configuration_named(configuration),),
        fabrics=(fabric,),
        repeats=repeat + 1,
        judged=1,
        every=1,
        draws=4,
    )
    tasks = [
        task
        for task in synthetic(plan)
        if task.scenario in motions
        and task.solver == "cloth"
        and (task.estimate is None or task.estimate.repeat == repeat)
    ]
    (estimate,) = {task.estimate for task in tasks if task.estimate is not None}
    return tasks, estimate


def _run(tasks: Sequence[Task], folder: Path) -> None:
    if failed := engine.run(tasks, folder, engine.Runner()):
        raise RuntimeError(next(iter(failed.values())))


def _errors(tasks: list[EvaluationTask], folder: Path) -> Line:
    """Run some evaluations: by motion floor, errors and skill."""
    every = [*ensembles(tasks), *tasks]
    _run(every, folder)
    rows = results.collect(tasks, folder)
    rows = rows[rows.metric == SURFACE]
    line: Line = {}
    for motion in dict.fromkeys(task.scenario for task in tasks):
        line |= _of(motion, rows[rows.evaluated_on == motion])
    return line | made_by(every, folder)


def _of(motion: str, rows: pd.DataFrame) -> Line:
    line: Line = {f"{motion}: floor": _millimetres(rows.floor.iloc[0])}
    for baseline, name in NAMED.items():
        values = rows[rows.baseline == baseline].value
        if len(values):  # another simulator's sheet has no true fabric
            line[f"{motion}: {name}"] = _millimetres(values.mean(skipna=False))
    (skill,) = set(rows[rows.baseline.isin(ESTIMATES)].skill)
    return line | {f"{motion}: skill": "unknown" if np.isnan(skill) else f"{skill:.2f}"}


def repeated(folder: Path, configuration: str, fabric: str, repeat: str) -> Line:
    """The line of a table: how an estimate from the recordings of that number stands to the truth,
    by parameter in its standard errors, in brackets what is not narrowed to half, and by how
    much the rest is off at most."""
    _, task = _tasks(configuration, fabric, int(repeat))
    _run([task], folder)
    estimate = read_estimate(task, folder)
    if estimate is None:
        return {"converged": "diverged"}
    off, away = _off(task, estimate)
    is_narrowed = estimate.narrowing < NARROWED
    line: Line = {}
    for bound, errors, is_known in zip(estimate.ranges, away, is_narrowed, strict=True):
        line[bound.name] = f"{errors:+.2f}" if is_known else f"({errors:+.2f})"
    known = np.abs(off[is_narrowed])
    return line | {
        "narrowed off at most": f"{known.max():.3f}" if len(known) else "-",
        "converged": "yes" if estimate.converged else "no",
        "recordings agree": _agreement(estimate, task),
    }


def _off(task: EstimateTask, estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """How far an estimate is from the truth, by parameter: in shares of it (the coupling as it is),
    and in standard errors, both as in the range."""
    true = results.true_values(task, estimate.ranges)
    rows = zip(estimate.ranges, estimate.values, true, strict=True)
    off = np.array([np.log(v / truth) if bound.log else v - truth for bound, v, truth in rows])
    return off, off / estimate.standard_errors


def _over_truth(task: EstimateTask, folder: Path) -> Line:
    estimate = read_estimate(task, folder)
    if estimate is None:
        return {"warp": "diverged"}
    off, away = _off(task, estimate)
    away = np.abs(away)
    line: Line = {}
    for bound, apart, errors in zip(estimate.ranges, off, away, strict=True):
        number = f"{np.exp(apart):.2f}" if bound.log else f"{apart:+.2f}"
        line[bound.name] = number + OUTSIDE * bool(errors >= norm.ppf(0.95))
    known = away[estimate.narrowing < NARROWED]
    fabrics = estimate.fabric, strain_dependent(task.fabric)
    for name, axis in (("warp", 0), ("weft", 1)):
        own, true = (f"{_growth(fabric, axis):.1%}" for fabric in fabrics)
        line[f"growth of {name} (truth)"] = f"{own} ({true})"
    return line | {
        "converged": "yes" if estimate.converged else "no",
        "outliers": ", ".join(f"{fit.outliers:.0%}" for fit in estimate.fits),
        "recordings agree": _agreement(estimate, task),
        "in 90 % intervals": f"{np.sum(away < norm.ppf(0.95))} of {len(away)}",
        "narrowed": f"{len(known)}",
        "errors off at most": f"{known.max():.1f}" if len(known) else "-",
    }


def _growth(fabric: Fabric, axis: int) -> float:
    """By how much the energy of a 5 % stretch exceeds that of constant stiffness, [-]."""
    strain = jnp.zeros(3).at[axis].set((1.05**2 - 1) / 2)
    small = getattr(fabric.membrane, "small", fabric.membrane)
    return float(fabric.membrane.energy_density(strain) / small.energy_density(strain)) - 1


def _agreement(estimate: Estimate, task: EstimateTask) -> str:
    """Whether the recordings do, by the likelihood by chance; else which does not."""
    if estimate.agreement is None:
        return "not judged"
    odd, p = estimate.agreement.contradiction, estimate.agreement.p
    if odd is None:
        return f"yes, {p:.2g}"
    return f"no, {p:.1g}: {task.sources[odd.recording].name}, {odd.parameter}"


def _millimetres(value: float) -> str:
    return "-" if np.isnan(value) else f"{1e3 * value:.1f}"
