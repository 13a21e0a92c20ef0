"""The results of a study: one table, the estimated parameters, and all that is published."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s._util.files import write_text
from r2s.estimation.default_spaces import law_of, with_law
from r2s.estimation.method import default_space
from r2s.materials.parameters import Range
from r2s.metrics import prediction_error
from r2s.study.estimates import ESTIMATE, EstimateTask, read_estimate
from r2s.study.evaluations import EvaluationTask, read_measured
from r2s.study.plan import Plan
from r2s.study.recordings import SyntheticRecording, read, true_fabric
from r2s.study.report import page
from r2s.study.report.figures import judged_recordings
from r2s.study.report.tables import tables_of_the_making
from r2s.study.statistics.frame import PLACE, as_frame, with_skill, write_results
from r2s.study.tasks import Task, provenance, result_files, with_dependencies
from r2s.study.verdicts import SURFACE, ensembles, judged_motions, verdicts

PRINTED = ("skill", "findings")  # the other tables are in files
PARAMETERS = ("solver", "recording", "parameter", "unit", "value", "low", "high",
              "posterior_over_prior", "truth")  # fmt: skip


def publish(
    tasks: Sequence[EvaluationTask],
    failed: dict[Task, str],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None = None,
) -> None:
    """Write `results.csv`, `estimates/`, `tables/` and `report.html`, and print the main tables.

    - `failed`: tasks without a result, and why.
    - `source`: where the recordings are from, in words.
    - `paper`: a folder with the tables of the paper.
    """
    results, estimates = collect(tasks, out), estimates_made(tasks, out)
    write_results(out / "results.csv", results)
    for task in estimates:
        with result_files(task, out) as files:
            if (files / ESTIMATE).exists():
                (out / "estimates").mkdir(exist_ok=True)
                write_text(out / f"estimates/{task.name}.json", (files / ESTIMATE).read_text())
    settings = {"recordings": source} | {f.name: str(getattr(plan, f.name)) for f in fields(plan)}
    made_by = provenance([*ensembles(tasks), *tasks], out)
    settings |= {f"cells made by {by}": str(count) for by, count in made_by.items()}
    tables = page.publish(
        out,
        results,
        judged_recordings(tasks, out),
        parameters(tasks, out),
        [(f"{task.kind} {task.name}", reason) for task, reason in failed.items()],
        settings,
        paper,
        tables_of_the_making(tasks, estimates, out),
    )
    for name in PRINTED:
        if name in tables:
            print(f"\n{tables[name].to_string(index=False)}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


def collect(tasks: Sequence[EvaluationTask], folder: Path) -> pd.DataFrame:
    """The results of all finished tasks (`r2s.study.statistics.frame`), and of given recordings the
    distances between trials."""
    known = judged_motions(tasks, folder)
    rows: dict[tuple, dict[str, Any]] = {}  # trials may share a recording and its references
    for task in tasks:
        if not task.is_made(folder):
            continue
        judged = verdicts(task, known, folder)
        for recording, measured in read_measured(task, folder).items():
            place = {
                **task.configuration._asdict(),
                "fabric": task.fabric,
                "repeat": task.repeat,
                "recording": recording,
                "evaluated_on": task.scenario,
                "baseline": task.baseline,
            }
            own = {row["metric"]: row for row in (*_metrics(measured), *judged.get(recording, ()))}
            for row in own.values():
                full = place | row
                rows.setdefault(tuple(full[name] for name in PLACE), full)
    results = as_frame([*rows.values(), *_repeatability(tasks, folder)])
    return with_skill(results, SURFACE)


def _metrics(measured: dict[str, float]) -> list[dict[str, Any]]:
    return [
        {"metric": name, "unit": prediction_error.UNITS.get(name, "m"), "value": value}
        for name, value in measured.items()
    ]


def _repeatability(tasks: Sequence[EvaluationTask], folder: Path) -> list[dict[str, Any]]:
    """The distances between successive trials of a fabric in a motion, for given recordings."""
    trials = defaultdict(list)
    for source in dict.fromkeys(source for task in tasks for source in task.recordings):
        if source.is_given and source.is_made(folder):
            trials[source.fabric, source.scenario].append(source)
    found = []
    for (fabric, scenario), sources in trials.items():
        if len(sources) < 2:
            continue
        for first, second in zip(sources, sources[1:] + sources[:1], strict=True):
            measured = prediction_error.against_recording(read(first, folder), read(second, folder))
            place = dict.fromkeys(PLACE, "") | {
                "fabric": fabric,
                "recording": first.name,
                "evaluated_on": scenario,
                "baseline": "repeatability",
            }
            found += [place | row for row in _metrics(measured)]
    return found


def estimates_made(tasks: Iterable[EvaluationTask], folder: Path) -> list[EstimateTask]:
    """The finished estimates that tasks depend on."""
    needed = with_dependencies(tasks)
    return [task for task in needed if isinstance(task, EstimateTask) and task.is_made(folder)]


def parameters(tasks: Iterable[EvaluationTask], folder: Path) -> pd.DataFrame:
    """The estimated parameters, a line each, with `PARAMETERS`.

    `low` and `high` are the ends of the 90 % interval [unit]; `truth` is NaN where it is not known.
    """
    rows = []
    for task in estimates_made(tasks, folder):
        estimate = read_estimate(task, folder)
        if estimate is None:
            continue
        truth = true_values(task, estimate.ranges)
        numbers = estimate.values, *estimate.intervals.T, estimate.narrowing, truth
        columns = [np.asarray(each).tolist() for each in numbers]
        for bound, *own in zip(estimate.ranges, *columns, strict=True):
            rows.append((task.solver, task.name, bound.name, bound.unit, *own))
    return pd.DataFrame(rows, columns=list(PARAMETERS))


def true_values(task: EstimateTask, ranges: Sequence[Range]) -> np.ndarray:
    """The parameters [unit of the range] of a synthetic recording's fabric, of constant ones those
    at small strain.

    NaN where unknown: of given recordings, of another simulator's sheet, and of multipliers of an
    assumed fabric.
    """
    source = task.sources[0]
    if (
        not isinstance(source, SyntheticRecording)
        or source.truth.materials
        or task.solver != "cloth"
    ):
        return np.full(len(ranges), np.nan)
    law = law_of(ranges)
    space = with_law(default_space("cloth", task.density), law)
    values = space.values(space.to_unit(true_fabric(task.fabric, law, source.truth)))
    known = {bound.name: float(v) for bound, v in zip(space.ranges, values, strict=True)}
    return np.array([known.get(bound.name, np.nan) for bound in ranges])
