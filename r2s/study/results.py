"""What the cells of a study found: the table of results, parameters, and all that is published."""

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
from r2s.study.cells import Cell, result_files, with_dependencies
from r2s.study.estimates import ESTIMATE, EstimateCell, read_estimate
from r2s.study.evaluations import EvaluationCell, read_measured
from r2s.study.matrix import Plan
from r2s.study.motions import judged_recordings
from r2s.study.origins import origins
from r2s.study.report import disclosures
from r2s.study.report.publish import publish as publish_report
from r2s.study.sources import SyntheticRecording, read, true_fabric
from r2s.study.statistics.frame import PLACE, as_frame, write_results
from r2s.study.statistics.means import with_skill
from r2s.study.verdicts import SURFACE, judged_motions, verdicts

PRINTED = ("skill", "findings")  # the other tables are in files
PARAMETERS = ("solver", "recording", "parameter", "unit", "is_log", "value", "standard_error",
              "is_identifiable", "truth")  # fmt: skip


def publish(
    cells: Sequence[EvaluationCell],
    failed: dict[Cell, str],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None = None,
) -> None:
    """Write `results.csv`, `estimates/`, `tables/` and `report.html`, and print the main tables.

    - `failed`: cells without a result, and why.
    - `source`: where the recordings are from, in words.
    - `paper`: a folder with the tables of the paper.
    """
    results = collect(cells, out)
    write_results(out / "results.csv", results)
    for cell in estimates_made(cells, out):
        with result_files(cell, out) as files:
            if (files / ESTIMATE).exists():
                (out / "estimates").mkdir(exist_ok=True)
                write_text(out / f"estimates/{cell.name}.json", (files / ESTIMATE).read_text())
    settings = {"recordings": source} | {f.name: str(getattr(plan, f.name)) for f in fields(plan)}
    settings |= {f"cells made by {by}": str(count) for by, count in origins(cells, out).items()}
    tables = publish_report(
        out,
        results,
        judged_recordings(cells, out),
        parameters(cells, out),
        [(f"{cell.kind} {cell.name}", reason) for cell, reason in failed.items()],
        settings,
        paper,
        [disclosures.section(cells, estimates_made(cells, out), out)],
    )
    for name in PRINTED:
        if name in tables:
            print(f"\n{tables[name].to_string(index=False)}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


def collect(cells: Iterable[EvaluationCell], folder: Path) -> pd.DataFrame:
    """The results of all cells that are made, in their order (`r2s.study.statistics.frame`), and of
    given recordings how far two trials differ."""
    cells = list(cells)
    known = judged_motions(cells, folder)
    rows: list[dict[str, Any]] = []
    for cell in cells:
        if not cell.is_made(folder):
            continue
        told = verdicts(cell, known, folder)
        for recording, measured in read_measured(cell, folder).items():
            place = {
                **cell.configuration._asdict(),
                "fabric": cell.fabric,
                "repeat": cell.repeat,
                "recording": recording,
                "evaluated_on": cell.scenario,
                "baseline": cell.baseline,
            }
            own = {row["metric"]: row for row in (*_metrics(measured), *told.get(recording, ()))}
            rows += [place | row for row in own.values()]
    # given trials may share some of what they are judged by, whose references are alike
    once = {tuple(row[name] for name in PLACE): row for row in reversed(rows)}
    results = as_frame([*reversed(once.values()), *_repeatability(cells, folder)])
    return with_skill(results, SURFACE)


def _metrics(measured: dict[str, float]) -> list[dict[str, Any]]:
    return [
        {"metric": name, "unit": prediction_error.UNITS.get(name, "m"), "value": value}
        for name, value in measured.items()
    ]


def _repeatability(cells: Sequence[EvaluationCell], folder: Path) -> list[dict[str, Any]]:
    """How far two trials of a fabric in a motion are from each other, for given recordings."""
    trials = defaultdict(list)
    for source in dict.fromkeys(source for cell in cells for source in cell.recordings):
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


def estimates_made(cells: Iterable[EvaluationCell], folder: Path) -> list[EstimateCell]:
    """The estimates that cells need and that are made."""
    needed = with_dependencies(cells)
    return [cell for cell in needed if isinstance(cell, EstimateCell) and cell.is_made(folder)]


def parameters(cells: Iterable[EvaluationCell], folder: Path) -> pd.DataFrame:
    """What was estimated, a line a parameter, with `PARAMETERS`.

    The standard error is relative for a logarithmic range, else in the unit; `truth` is NaN where
    it is not known.
    """
    rows = []
    for cell in estimates_made(cells, folder):
        estimate = read_estimate(cell, folder)
        if estimate is None:
            continue
        truth = true_values(cell, estimate.ranges)
        numbers = estimate.values, estimate.standard_errors, estimate.identifiable, truth
        columns = [np.asarray(each).tolist() for each in numbers]
        for bound, *own in zip(estimate.ranges, *columns, strict=True):
            rows.append((cell.solver, cell.name, bound.name, bound.unit, bound.log, *own))
    return pd.DataFrame(rows, columns=list(PARAMETERS))


def true_values(cell: EstimateCell, ranges: Sequence[Range]) -> np.ndarray:
    """The parameters [unit of the range] of a synthetic recording's fabric, of constant ones those
    at small strain; NaN where unknown, as of given recordings, of another simulator's sheet, and of
    multipliers of an assumed fabric."""
    source = cell.sources[0]
    if (
        cell.solver != "cloth"
        or not isinstance(source, SyntheticRecording)
        or source.truth.materials
    ):
        return np.full(len(ranges), np.nan)
    law = law_of(ranges)
    space = with_law(default_space("cloth", cell.density), law)
    values = space.values(space.to_unit(true_fabric(cell.fabric, law, source.truth)))
    known = {bound.name: float(v) for bound, v in zip(space.ranges, values, strict=True)}
    return np.array([known.get(bound.name, np.nan) for bound in ranges])
