"""What every approach is given, and what all are judged by: recordings, and what it reads."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from r2s.estimation.method import Reads
from r2s.recordings.recording import Recording
from r2s.scenarios.synthetic import Sensing
from r2s.study.cells import with_dependencies
from r2s.study.estimates import EstimateCell, method_of
from r2s.study.evaluations import EvaluationCell
from r2s.study.sources import GivenRecording, Source, read
from r2s.study.tables import MISSING, Table

HEADER = (
    "used by",
    "motion",
    "recordings of a fabric",
    "seen by",
    "frames read",
    "points of a frame",
    "markers",
    "force of grippers",
    "prior",
    "laws",
)
CAPTION = (
    "Data of every approach, as its code reads them, and of the motions to judge by; all know the "
    "sheet, the grippers' path and the wind, and with the prior fabrics what fabrics of its weight "
    "are like"
)


def data_table(cells: Iterable[EvaluationCell], folder: Path) -> Table:
    """A line for each configuration that has an estimate, and one for each motion that is judged.

    The numbers are those of the first recordings that are made; a line without any is left out.
    """
    cells = list(cells)
    lines = [*_of_estimates(cells, folder), *_of_judged(cells, folder)]
    return Table(HEADER, tuple(lines), CAPTION)


def _of_estimates(cells: list[EvaluationCell], folder: Path) -> list[tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for cell in with_dependencies(cells):
        if not isinstance(cell, EstimateCell) or not all(s.is_made(folder) for s in cell.sources):
            continue
        label = f"{cell.approach} on {cell.solver}"
        if f"{label} {cell.scenario}" in found:
            continue
        seen = [read(source, folder) for source in cell.sources]
        reads = [method_of(cell).reads(recording) for recording in seen]
        found[f"{label} {cell.scenario}"] = (
            label,
            cell.scenario,
            str(len(seen)),
            "; ".join(dict.fromkeys(map(seen_by, cell.sources, reads))),
            *_numbers(seen, reads),
            cell.prior,
            cell.law_from(seen),
        )
    return list(found.values())


def _of_judged(cells: list[EvaluationCell], folder: Path) -> list[tuple[str, ...]]:
    judged: Mapping[tuple[str, str], dict[Source, int]] = defaultdict(dict)
    every = {}
    for cell in cells:
        for source in cell.recordings:
            judged[cell.scenario, cell.fabric][source] = 0
            every[cell.scenario] = cell.every
    lines = {}
    for (scenario, _), sources in judged.items():
        made = [source for source in sources if source.is_made(folder)]
        if scenario in lines or not made:
            continue
        recording = read(made[0], folder)
        first, last = recording.info.frames_used
        reads = Reads(tuple(range(first, last + 1, every[scenario])), points=None)
        by = seen_by(made[0], reads)
        lines[scenario] = ("judged by", scenario, str(len(sources)), by)
        lines[scenario] += (*_numbers([recording], [reads]), MISSING, MISSING)
    return list(lines.values())


def seen_by(source: Source, reads: Reads) -> str:
    """Which cameras show what is read of a recording, and with which errors."""
    if isinstance(source, GivenRecording):
        return "the recording's own"
    if reads.markers:
        return "markers and load cell, with noise"
    sensing: Sensing | None = source.sensing
    if sensing is None:
        return MISSING
    if not sensing.cameras:
        return "whole surface"
    errors = f"noise {1e3 * sensing.noise:g} mm, outliers {sensing.outliers:.0%}"
    return f"{len(sensing.cameras)} depth cameras, {errors}"


def _numbers(seen: list[Recording], reads: list[Reads]) -> tuple[str, ...]:
    """Frames, points, markers and force of recordings that one estimate is made from."""
    clouds = [_points(*each) for each in zip(seen, reads, strict=True)]
    marked = [
        recording.markers.shape[1] if each.markers and recording.markers is not None else 0
        for recording, each in zip(seen, reads, strict=True)
    ]
    return (
        _one_or_more(len(each.frames) for each in reads),
        _one_or_more(clouds),
        _one_or_more(marked),
        "yes" if any(each.force for each in reads) else MISSING,
    )


def _points(recording: Recording, reads: Reads) -> int:
    """The mean over the frames that are read of how many points are."""
    if reads.points == 0:
        return 0
    there = np.asarray(recording.mask)[list(reads.frames)].sum(axis=1)
    most = there.max() if reads.points is None else reads.points
    return round(float(np.minimum(there, most).mean()))


def _one_or_more(numbers: Iterable[int]) -> str:
    """One number if all are alike, else from the least to the greatest; nothing for 0."""
    low, high = (pick(numbers := list(numbers)) for pick in (min, max))
    if not high:
        return MISSING
    return f"{low}" if low == high else f"{low} to {high}"
