"""What the cells of a study found, as rows, parameters and costs."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from r2s.evaluation import prediction_error
from r2s.fabrics.parameters import Range
from r2s.files import write_text
from r2s.recordings.recording import cloud
from r2s.scenarios.scenario import from_recording
from r2s.study.cells import Cell, about, result_files
from r2s.study.engine import with_dependencies
from r2s.study.estimates import ESTIMATE, EstimateCell, family_of, read_estimate
from r2s.study.evaluations import EvaluationCell, read_measured, read_motion
from r2s.study.matrix import PRESETS, Plan, synthetic
from r2s.study.report.motions import MotionComparison
from r2s.study.sources import Source, SyntheticRecording, read, small_strain
from r2s.study.statistics.result_array import Configuration
from r2s.study.tables import Row, Table, pivot, significant, write_rows

PRINTED = ("findings.md", "chamfer_real_to_sim*.md", "diff*_on_*.md")  # the others are in files

Entry = tuple[str, tuple[Range, ...], Any, Any, Any, Any]


def publish(
    cells: Sequence[EvaluationCell],
    failed: dict[Cell, str],
    out: Path,
    plan: Plan,
    source: str,
    paper: Path | None = None,
) -> None:
    """Write `results.csv`, `estimates/`, tables, pictures and `report.html` of a study, and print
    its tables; nothing but the tables again when nothing has changed, nor is gone."""
    changed = sha256(repr([[c.key for c in cells], missing(failed), str(paper)]).encode())
    mark = out / ".published"
    if not _is_published(out, mark, changed.hexdigest()):
        found = rows(cells, out)
        write_rows(out / "results.csv", found)
        for cell in estimated(cells, out):
            with result_files(cell, out) as files:
                if (files / ESTIMATE).exists():
                    (out / "estimates").mkdir(exist_ok=True)
                    write_text(out / f"estimates/{cell.name}.json", (files / ESTIMATE).read_text())
        settings = {"recordings": source} | {
            field.name: str(getattr(plan, field.name)) for field in fields(plan)
        }
        from r2s.study.report import full

        for old in (out / "tables").glob("*.*"):
            old.unlink()
        took = costs(cells, out)
        by = list(by_recording(found).items())
        larger = [(f"forecast_{name}", forecast(took, larger)) for name, larger in PRESETS.items()]
        full.publish(
            out,
            found,
            shown(cells, out),
            parameters(cells, out),
            missing(failed),
            settings,
            paper,
            took,
            [
                ("Every recording", "Mean over the frames that count.", by),
                ("What larger studies would take", "From the costs of this one.", larger),
            ],
        )
        write_text(mark, changed.hexdigest())
    for name in PRINTED:
        for table in sorted((out / "tables").glob(name)):
            print(f"\n{table.read_text(encoding='utf-8')}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


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
    return found + _repeatability(cells, folder)


def _rows(cell: EvaluationCell, folder: Path) -> list[Row]:
    estimate = cell.estimate
    baseline = "default" if estimate is None else "other_fabric" if cell.other else ""
    return [
        Row(
            *cell.configuration,
            cell.fabric,
            cell.repeat,
            name,
            cell.scenario,
            baseline,
            metric,
            prediction_error.UNITS.get(metric, "m"),
            value,
        )
        for name, measured in read_measured(cell, folder).items()
        for metric, value in measured.items()
    ]


def _repeatability(cells: Sequence[EvaluationCell], folder: Path) -> list[Row]:
    """How far two trials of a fabric in a motion are from each other; of given recordings alone."""
    trials = defaultdict(list)
    for source in dict.fromkeys(source for cell in cells for source in cell.recordings):
        if not isinstance(source, SyntheticRecording) and source.is_made(folder):
            trials[source.fabric, source.scenario].append(source)
    found = []
    for (fabric, scenario), sources in trials.items():
        for first, second in zip(sources, sources[1:] + sources[:1], strict=True):
            if first is second:
                continue
            measured = prediction_error.against_recording(read(first, folder), read(second, folder))
            about_it = "", "", "", fabric, "", first.name, scenario, "repeatability"
            found += [
                Row(*about_it, metric, prediction_error.UNITS.get(metric, "m"), value)
                for metric, value in measured.items()
            ]
    return found


def by_recording(rows: Sequence[Row], metric: str = "chamfer_real_to_sim") -> dict[str, Table]:
    """One table a configuration and scenario: each recording's error beside that of the default fabric, of
    another fabric's estimate and of another trial. Of given recordings alone, where an estimate is
    judged by what belongs to it."""
    configurations = dict.fromkeys(
        Configuration(row.approach, row.solver, row.estimated_from)
        for row in rows
        if row.approach and row.baseline == "other_fabric"
    )
    found = {}
    for configuration in configurations:
        theirs = [
            row
            for row in rows
            if (row.approach, row.estimated_from)
            in ((configuration.approach, configuration.estimated_from), ("", ""))
            and row.solver in (configuration.solver, "")
        ]
        # where several estimates are judged by one recording, the first
        first = {(r.recording, r.evaluated_on, r.baseline, r.metric): r for r in reversed(theirs)}
        theirs = list(reversed(first.values()))
        for scenario in dict.fromkeys(row.evaluated_on for row in theirs):
            table = pivot(theirs, metric, scenario)
            name = f"{'_'.join(configuration)}_on_{scenario}"
            found[name] = replace(table, caption=f"{configuration.label}: {table.caption}")
    return found


def parameters(cells: Iterable[EvaluationCell], folder: Path) -> dict[str, list[Entry]]:
    """What was estimated, by solver, as `r2s.study.tables.parameter_table` takes it."""
    found: dict[str, list[Entry]] = {}
    for cell in estimated(cells, folder):
        estimate = read_estimate(cell, folder)
        if estimate is not None:
            numbers = estimate.values, estimate.standard_errors, estimate.identifiable
            entry = (cell.name, estimate.ranges, *numbers, _truth(cell))
            found.setdefault(cell.solver, []).append(entry)
    return found


def estimated(cells: Iterable[EvaluationCell], folder: Path) -> list[EstimateCell]:
    """The estimates that are made."""
    every = with_dependencies(cells)
    return [cell for cell in every if isinstance(cell, EstimateCell) and cell.is_made(folder)]


def _truth(cell: EstimateCell) -> np.ndarray | None:
    """The parameters at small strain of a made recording's fabric, on the cloth."""
    source = cell.sources[0]
    if (
        cell.solver != "cloth"
        or not isinstance(source, SyntheticRecording)
        or source.truth_settings.materials
    ):
        return None
    space = family_of("cloth", cell.density)
    return np.asarray(space.values(space.locate(small_strain(cell.fabric))))


def shown(cells: Iterable[EvaluationCell], folder: Path) -> list[MotionComparison]:
    """The first recording of each fabric and scenario with its simulations by all configurations that are
    made, at the frames that count."""
    groups: dict[Source, dict[str, np.ndarray]] = {}
    for cell in cells:
        label, motions = cell.configuration.label, groups.setdefault(cell.recordings[0], {})
        if label not in motions and not cell.other and cell.is_made(folder):
            motions[label] = read_motion(cell, folder)
    found = []
    for source, motions in groups.items():
        if not motions:
            continue
        recording = read(source, folder)
        first, last = recording.info.frames_used
        frames = range(first, last + 1)
        found.append(
            MotionComparison(
                source.fabric,
                source.scenario,
                source.name,
                np.asarray(recording.times)[first : last + 1],
                tuple(cloud(recording, frame) for frame in frames),
                np.asarray(from_recording(recording).scene.mesh.faces),
                {label: x[first : last + 1] for label, x in motions.items()},
            )
        )
    firsts = {(s.fabric, s.evaluated_on): s for s in reversed(found)}
    return [s for s in found if firsts[s.fabric, s.evaluated_on] is s]


def costs(cells: Iterable[EvaluationCell], folder: Path) -> list[dict[str, Any]]:
    """Of cells alike: their number, CPU seconds (compilation included) in all and the median of
    each (of each recording, where one judges several), and peak memory [MB]."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for cell in with_dependencies(cells):
        if cell.is_made(folder):
            groups[cell.alike].append(about(cell, folder))
    return [
        {
            "kind": alike,
            "count": len(found),
            "seconds": float(np.sum([a["cpu_seconds"] for a in found])),
            "each": float(np.median([a["cpu_seconds"] / a.get("runs", 1) for a in found])),
            "peak_memory_MB": float(np.max([a["peak_memory_MB"] for a in found])),
        }
        for alike, found in groups.items()
    ]


def forecast(costs: Sequence[dict[str, Any]], plan: Plan, cores: Sequence[int] = (2, 16)) -> Table:
    """What another study of synthetic recordings would take, from the costs of one that was made.

    CPU seconds of cells alike, the median of those made (compilation is in the first of each alone,
    so not in the median of many); a cell that judges is counted by its recordings. Cells that none
    made is like are said to be not measured, and left out of the sum.
    """
    of_kind = {cost["kind"]: cost["each"] for cost in costs}
    groups: dict[str, float] = defaultdict(float)
    for cell in with_dependencies(synthetic(plan)):
        groups[cell.alike] += len(cell.recordings) if isinstance(cell, EvaluationCell) else 1
    lines, total = [], 0.0
    for alike, count in groups.items():
        each = of_kind.get(alike)
        hours = math.nan if each is None else each * count / 3600
        total += 0.0 if each is None else hours
        known = each is not None
        shown = significant(each) if known else "not measured"
        lines.append((alike, f"{count:.0f}", shown, significant(hours) if known else "-"))
    on = ", ".join(f"{significant(total / n)} hours on {n} cores" for n in cores)
    return Table(
        header=("cells", "number", "CPU seconds each", "CPU hours"),
        rows=(*lines, ("measured in all", "", "", significant(total))),
        caption=f"What it would take: {on}, if all cores are busy",
        foot=1,
    )


def missing(failed: dict[Cell, str]) -> list[tuple[str, str]]:
    """The cells that are missing, and why."""
    return [(f"{cell.kind} {cell.name}", reason) for cell, reason in failed.items()]
