"""What the cells of a study found, as rows, parameters and costs."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2s.family import Range
from r2s.study import judge
from r2s.study.cells import Cell, about
from r2s.study.engine import closure
from r2s.study.estimates import Estimated, family_of, read_estimate
from r2s.study.evaluations import Judged, read_measured
from r2s.study.tables import Row
from r2s.study.truths import Made, read, small_strain

Entry = tuple[str, tuple[Range, ...], Any, Any, Any, Any]


def rows(cells: Iterable[Judged], folder: Path) -> list[Row]:
    """The rows of all cells that are made, in their order, then what two trials differ by."""
    cells = list(cells)
    found = [row for cell in cells if cell.is_made(folder) for row in _rows(cell, folder)]
    return found + _repeatability(cells, folder)


def _rows(cell: Judged, folder: Path) -> list[Row]:
    estimate = cell.estimate
    column = (estimate.approach, estimate.solver, estimate.scenario) if estimate else None
    baseline = "default" if estimate is None else "other_fabric" if cell.other else ""
    return [
        Row(
            *(column or ("", cell.solver, "")),
            cell.fabric,
            str(estimate.repeat) if estimate else "",
            name,
            cell.scenario,
            baseline,
            metric,
            judge.UNITS.get(metric, "m"),
            value,
        )
        for name, measured in read_measured(cell, folder).items()
        for metric, value in measured.items()
    ]


def _repeatability(cells: Sequence[Judged], folder: Path) -> list[Row]:
    """How far two trials of a fabric in a motion are from each other; of given recordings alone."""
    trials = defaultdict(list)
    for source in dict.fromkeys(source for cell in cells for source in cell.recordings):
        if not isinstance(source, Made) and source.is_made(folder):
            trials[source.fabric, source.scenario].append(source)
    found = []
    for (fabric, scenario), sources in trials.items():
        for first, second in zip(sources, sources[1:] + sources[:1], strict=True):
            if first is second:
                continue
            measured = judge.against_recording(read(first, folder), read(second, folder))
            about_it = "", "", "", fabric, "", first.name, scenario, "repeatability"
            found += [
                Row(*about_it, metric, judge.UNITS.get(metric, "m"), value)
                for metric, value in measured.items()
            ]
    return found


def parameters(cells: Iterable[Judged], folder: Path) -> dict[str, list[Entry]]:
    """What was estimated, by solver, as `r2s.study.tables.parameter_table` takes it."""
    found: dict[str, list[Entry]] = {}
    for cell in closure(cells):
        if not isinstance(cell, Estimated) or not cell.is_made(folder):
            continue
        estimate = read_estimate(cell, folder)
        if estimate is not None:
            numbers = estimate.values, estimate.deviations, estimate.determined
            entry = (cell.name, estimate.ranges, *numbers, _truth(cell))
            found.setdefault(cell.solver, []).append(entry)
    return found


def _truth(cell: Estimated) -> np.ndarray | None:
    """The parameters at small strain of a made recording's fabric, on the cloth."""
    source = cell.sources[0]
    if cell.solver != "cloth" or not isinstance(source, Made) or source.making.materials:
        return None
    family = family_of("cloth", cell.density)
    return np.asarray(family.values(family.locate(small_strain(cell.fabric))))


def costs(cells: Iterable[Judged], folder: Path) -> list[dict[str, Any]]:
    """CPU seconds (compilation included), their number and peak memory [MB] of cells alike."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for cell in closure(cells):
        if cell.is_made(folder):
            groups[cell.alike].append(about(cell, folder))
    return [
        {
            "kind": alike,
            "count": len(found),
            "seconds": float(np.sum([a["cpu_seconds"] for a in found])),
            "each": float(np.median([a["cpu_seconds"] for a in found])),
            "peak_memory_MB": float(np.max([a["peak_memory_MB"] for a in found])),
        }
        for alike, found in groups.items()
    ]


def missing(failed: dict[Cell, str]) -> list[tuple[str, str]]:
    """The cells that are missing, and why."""
    return [(f"{cell.kind} {cell.name}", reason) for cell, reason in failed.items()]
