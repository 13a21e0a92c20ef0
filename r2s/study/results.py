"""What the cells of a study found: rows, parameters and motions, and all that is published."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import fields
from hashlib import sha256
from pathlib import Path

import numpy as np

from r2s.estimation.default_spaces import law_of, with_law
from r2s.estimation.method import default_space
from r2s.evaluation import prediction_error
from r2s.fabrics.fold_length import fold_length
from r2s.fabrics.parameters import Range
from r2s.files import write_text
from r2s.scenarios.resolution import ENOUGH, mesh_error
from r2s.study.cells import Cell, read_metadata, result_files, with_dependencies
from r2s.study.comparisons import motion_comparisons
from r2s.study.costs import cost_table, costs, forecast
from r2s.study.estimates import ESTIMATE, EstimateCell, read_estimate
from r2s.study.evaluations import EvaluationCell, read_measured
from r2s.study.matrix import PRESETS, Plan
from r2s.study.origins import origins
from r2s.study.report.data_table import data_table
from r2s.study.report.parameter_ranges import range_table, truth_settings
from r2s.study.report.truth_table import truth_table
from r2s.study.rows import Row, place_of, write_rows
from r2s.study.sources import GivenRecording, SyntheticRecording, read, true_fabric
from r2s.study.statistics.parameters import Estimated
from r2s.study.statistics.recordings import recording_tables
from r2s.study.tables import MISSING, Table, significant
from r2s.study.verdicts import with_verdicts

MESHES = (
    "What the mesh of each estimate is expected to leave in the motion that it was made from, for "
    "the fabric that came out: the distance from a fine sheet of the same fabric, over the sheet "
    "and the motion. What meshes leave in the motions that are judged stands in the table of "
    "truths. Predictions are simulated as their table says."
)
DATA = (
    "Approaches differ in what they are given; a difference between them, in ranks and findings "
    "too, may be that of their data, or of the prior."
)
RANGES = (
    "Searches begin in the middle, or among places that are even over the range (over its "
    "logarithm, but for the coupling and nu), so what a motion does not tell comes from here. "
    "DIFFCLOUD on the cloth begins in the middle of the prior instead, and is drawn to it. That is "
    "the prior of the default fabric (r2s.fabrics.prior): it was not laid around the study's "
    "fabrics."
)
# The others are in files.
PRINTED = ("skill.md", "findings.md", "chamfer_real_to_sim*.md", "diff*_on_*.md")


def publish(
    cells: Sequence[EvaluationCell],
    failed: dict[Cell, str],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None = None,
) -> None:
    """Write `results.csv`, `estimates/`, tables, pictures and `report.html`, and print the tables.

    - `failed`: cells without a result, and why.
    - `source`: where the recordings are from, in words.
    - `paper`: a folder with the tables of the paper.

    Only prints when nothing has changed since, and nothing is gone.
    """
    missing = [(f"{cell.kind} {cell.name}", reason) for cell, reason in failed.items()]
    changed = sha256(repr([[c.key for c in cells], missing, str(paper)]).encode()).hexdigest()
    mark = out / ".published"
    if not _is_published(out, mark, changed):
        _publish(cells, missing, out, plan, source, paper)
        write_text(mark, changed)
    for name in PRINTED:
        for table in sorted((out / "tables").glob(name)):
            print(f"\n{table.read_text(encoding='utf-8')}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


def _publish(
    cells: Sequence[EvaluationCell],
    missing: Sequence[tuple[str, str]],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None,
) -> None:
    from r2s.study.report import full

    found = rows(cells, out)
    write_rows(out / "results.csv", found)
    for cell in estimates_made(cells, out):
        with result_files(cell, out) as files:
            if (files / ESTIMATE).exists():
                (out / "estimates").mkdir(exist_ok=True)
                write_text(out / f"estimates/{cell.name}.json", (files / ESTIMATE).read_text())
    for old in (out / "tables").glob("*.*"):
        old.unlink()
    took, meshes = costs(cells, out), mesh_table(cells, out)
    forecasts = {f"forecast_{name}": forecast(took, larger) for name, larger in PRESETS.items()}
    full.publish(
        out,
        found,
        motion_comparisons(cells, out),
        parameters(cells, out),
        missing,
        {"recordings": source}
        | {f.name: str(getattr(plan, f.name)) for f in fields(plan)}
        | truth_settings(plan.truth, _presets_of(cells))
        | {f"cells made by {words}": str(count) for words, count in origins(cells, out).items()},
        paper,
        [
            ("Truths", "", _if_any(truths=truth_table(cells, out))),
            ("Data", DATA, _if_any(data=data_table(cells, out))),
            ("Ranges and fixed values", RANGES, _if_any(ranges=range_table(cells))),
            ("Costs", "", {"costs": cost_table(took)} if took else {}),
            ("Meshes and steps", MESHES, _if_any(meshes=meshes, steps=steps_table(cells, out))),
            ("Every recording", "Mean over the frames that count.", recording_tables(found)),
            ("What larger studies would take", "From the costs of this one.", forecasts),
        ],
    )


def _if_any(**tables: Table) -> dict[str, Table]:
    """Those that have lines."""
    return {name: table for name, table in tables.items() if table.rows}


def _presets_of(cells: Iterable[EvaluationCell]) -> list[str]:
    """Fabrics of the synthetic recordings that are judged by."""
    sources = [source for cell in cells for source in cell.recordings]
    made = [source.fabric for source in sources if isinstance(source, SyntheticRecording)]
    return list(dict.fromkeys(made))


def _is_published(out: Path, mark: Path, changed: str) -> bool:
    """Whether what was published last is there, and of these cells as they are now."""
    if not all(path.exists() for path in (mark, out / "results.csv", out / "report.html")):
        return False
    made = mark.stat().st_mtime
    newer = any(path.stat().st_mtime > made for path in (out / "cells").rglob("*.zip"))
    return not newer and mark.read_text(encoding="utf-8") == changed


def rows(cells: Iterable[EvaluationCell], folder: Path) -> list[Row]:
    """The rows of all cells that are made, in their order, then what two trials differ by."""
    cells = list(cells)
    found = [row for cell in cells if cell.is_made(folder) for row in _rows(cell, folder)]
    # given trials may share some of what they are judged by, whose references are alike
    once = list({place_of(row): row for row in reversed(found)}.values())[::-1]
    return with_verdicts(once, cells, folder) + _repeatability(cells, folder)


def _rows(cell: EvaluationCell, folder: Path) -> list[Row]:
    return [
        Row(
            *cell.configuration,
            fabric=cell.fabric,
            repeat=cell.repeat,
            recording=name,
            evaluated_on=cell.scenario,
            baseline=cell.baseline,
            metric=metric,
            unit=prediction_error.UNITS.get(metric, "m"),
            value=value,
        )
        for name, measured in read_measured(cell, folder).items()
        for metric, value in measured.items()
    ]


def _repeatability(cells: Sequence[EvaluationCell], folder: Path) -> list[Row]:
    """How far two trials of a fabric in a motion are from each other, for given recordings."""
    trials = defaultdict(list)
    for source in dict.fromkeys(source for cell in cells for source in cell.recordings):
        if isinstance(source, GivenRecording) and source.is_made(folder):
            trials[source.fabric, source.scenario].append(source)
    found = []
    for (fabric, scenario), sources in trials.items():
        if len(sources) < 2:
            continue
        for first, second in zip(sources, sources[1:] + sources[:1], strict=True):
            measured = prediction_error.against_recording(read(first, folder), read(second, folder))
            found += [
                Row(
                    approach="",
                    solver="",
                    estimated_from="",
                    fabric=fabric,
                    repeat="",
                    recording=first.name,
                    evaluated_on=scenario,
                    baseline="repeatability",
                    metric=metric,
                    unit=prediction_error.UNITS.get(metric, "m"),
                    value=value,
                )
                for metric, value in measured.items()
            ]
    return found


def estimates_made(cells: Iterable[EvaluationCell], folder: Path) -> list[EstimateCell]:
    """The estimates that cells need and that are made."""
    needed = with_dependencies(cells)
    return [cell for cell in needed if isinstance(cell, EstimateCell) and cell.is_made(folder)]


def mesh_table(cells: Iterable[EvaluationCell], folder: Path) -> Table:
    """What error the mesh of each estimate is expected to leave (`r2s.scenarios.resolution`).

    As it was measured on the cloth, for a sheet of the size of the recording it was made from.
    """
    lines = []
    for cell in estimates_made(cells, folder):
        estimate = read_estimate(cell, folder)
        if estimate is None or estimate.shape is None:
            continue
        size = read(cell.sources[0], folder).info.sheet.size
        error = mesh_error(estimate.fabric, size, estimate.shape, cell.sources[0].scenario)
        folds = significant(1e3 * float(fold_length(estimate.fabric)))
        told = significant(1e3 * error) if np.isfinite(error) else MISSING
        lines.append((cell.name, f"{estimate.shape[0]} x {estimate.shape[1]}", folds, told))
    header = ("estimate", "mesh", "fold length [mm]", "expected error [mm]")
    return Table(header, tuple(lines), f"Expected errors of meshes; {1e3 * ENOUGH:.0f} mm is fine")


def steps_table(cells: Iterable[EvaluationCell], folder: Path) -> Table:
    """How predictions were simulated: how many runs of each motion on each solver, by mesh and kind
    of steps."""
    counts: dict[tuple[str, ...], int] = defaultdict(int)
    for cell in cells:
        if cell.is_made(folder):
            mesh = f"{cell.shape[0]} x {cell.shape[1]}"
            for steps in read_metadata(cell, folder).get("steps", {}).values():
                counts[cell.solver, cell.scenario, mesh, steps] += 1
    lines = [(*which, str(count)) for which, count in sorted(counts.items())]
    header = ("solver", "motion", "mesh", "steps", "runs")
    return Table(header, tuple(lines), "How predictions were simulated")


def parameters(cells: Iterable[EvaluationCell], folder: Path) -> dict[str, list[Estimated]]:
    """What was estimated, by solver."""
    found: dict[str, list[Estimated]] = defaultdict(list)
    for cell in estimates_made(cells, folder):
        estimate = read_estimate(cell, folder)
        if estimate is not None:
            found[cell.solver].append(
                Estimated(
                    cell.name,
                    estimate.ranges,
                    estimate.values,
                    estimate.standard_errors,
                    estimate.identifiable,
                    true_values(cell, estimate.ranges),
                )
            )
    return found


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
