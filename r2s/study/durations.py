"""How long cells take, roughly: for the forecast of a study and its progress.

CPU seconds of one core. Cells of one compilation group compile once: the first takes longer.
"""

from collections.abc import Iterable

from r2s.study.cells import Cell

# By the beginning of a compilation group, the longest that fits: seconds of the first recording,
# with compilation, and of each further one.
SECONDS: dict[str, tuple[float, float]] = {
    "networks cloth": (100.0, 100.0),
    "networks points": (200.0, 200.0),
    "recordings": (25.0, 15.0),
    "recordings of MuJoCo": (60.0, 60.0),
    "ensembles": (100.0, 60.0),
    "ensembles of MuJoCo": (200.0, 200.0),
    "estimates diffcloud": (250.0, 200.0),
    "estimates diffcloud cloth wind": (500.0, 400.0),
    "estimates diffcloud cloth lifting+": (1000.0, 800.0),
    "estimates diffcp": (300.0, 250.0),
    "estimates physnet": (60.0, 40.0),
    "estimates pinn": (120.0, 100.0),
    "evaluations": (15.0, 8.0),
}
OTHERS = (1.0, 1.0)  # of a group that is not there


def expected_seconds(cells: Iterable[Cell]) -> dict[Cell, float]:
    """The time of each cell, [CPU s], when they are made in this order."""
    compiled: set[str] = set()
    found = {}
    for cell in cells:
        group = cell.compilation_group
        first, further = _of_group(group)
        found[cell] = (further if group in compiled else first) + (cell.runs - 1) * further
        compiled.add(group)
    return found


def _of_group(group: str) -> tuple[float, float]:
    fitting = [name for name in SECONDS if group.startswith(name)]
    return SECONDS[max(fitting, key=len)] if fitting else OTHERS


def in_words(seconds: float) -> str:
    """A time [s] in seconds, minutes or hours, such as "20 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.0f} h"
