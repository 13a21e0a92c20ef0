"""What the cells of a study took, and what another study would take."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from r2s.study.cells import Cell, read_metadata, with_dependencies
from r2s.study.evaluations import EvaluationCell
from r2s.study.matrix import Plan, synthetic
from r2s.study.tables import Table, significant
from r2s.study.verdicts import ensembles

CORES = (2, 16)  # of the machines for which a forecast is made


class Cost(NamedTuple):
    """What cells of one group took, compilation included.

    - `seconds`: CPU time of all, [s].
    - `each`: the median of each (of each recording, where one cell judges several), [s].
    - `peak_memory`: [MB].
    """

    group: str
    count: int
    seconds: float
    each: float
    peak_memory: float


def costs(cells: Iterable[Cell], folder: Path) -> list[Cost]:
    """The costs of cells, what they need, and their ensembles, as far as they are made."""
    groups, cells = defaultdict(list), list(cells)
    judges = [cell for cell in cells if isinstance(cell, EvaluationCell)]
    for cell in with_dependencies([*ensembles(judges), *cells]):
        if cell.is_made(folder):
            groups[cell.compilation_group].append(read_metadata(cell, folder))
    return [
        Cost(
            group=group,
            count=len(found),
            seconds=float(np.sum([m["cpu_seconds"] for m in found])),
            each=float(np.median([m["cpu_seconds"] / m.get("runs", 1) for m in found])),
            peak_memory=float(np.max([m["peak_memory_MB"] for m in found])),
        )
        for group, found in groups.items()
    ]


def cost_table(costs: Sequence[Cost]) -> Table:
    header = ("kind", "count", "CPU seconds in all", "CPU seconds of one (median)",
              "peak memory [MB]")  # fmt: skip
    lines = [(group, str(count), *map(significant, rest)) for group, count, *rest in costs]
    return Table(header, tuple(lines), "What it took, compilation included")


def forecast(costs: Sequence[Cost], plan: Plan) -> Table:
    """What another study of synthetic recordings would take, from the costs of one that was made.

    It counts the median CPU time of the cells of a group: compilation is in the first of them
    alone, so not in the median of many. A cell that judges counts by its recordings. Groups of
    which no cell was made are said to be not measured, and left out of the sum.
    """
    seconds = {cost.group: cost.each for cost in costs}
    counts: dict[str, int] = defaultdict(int)
    cells = synthetic(plan)
    for cell in with_dependencies([*ensembles(cells), *cells]):
        counts[cell.compilation_group] += (
            len(cell.recordings) if isinstance(cell, EvaluationCell) else 1
        )
    hours = {group: seconds.get(group, math.nan) * count / 3600 for group, count in counts.items()}
    total = sum(value for value in hours.values() if not math.isnan(value))
    lines = [
        (group, str(count), significant(seconds[group]), significant(hours[group]))
        if group in seconds
        else (group, str(count), "not measured", "-")
        for group, count in counts.items()
    ]
    on = ", ".join(f"{significant(total / cores)} hours on {cores} cores" for cores in CORES)
    return Table(
        header=("cells", "number", "CPU seconds each", "CPU hours"),
        rows=(*lines, ("measured in all", "", "", significant(total))),
        caption=f"What it would take: {on}, if all cores are busy",
        foot=1,
    )
