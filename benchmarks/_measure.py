"""Times of calls and memory of programs; tables are those of `experiments/_tables.py`."""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).parents[1] / "experiments"))
from _tables import Line, command_line, keep  # noqa: E402

__all__ = ["Line", "Times", "command_line", "keep", "memory", "timed"]


class Times(NamedTuple):
    """Median, least and most seconds of some calls."""

    median: float
    least: float
    most: float

    def __str__(self) -> str:
        return f"{self.median:.3g} ({self.least:.3g} to {self.most:.3g})"


def timed(call: Callable[[], Any], repeats: int, wall: bool = False) -> tuple[Times, Any]:
    """CPU seconds of all threads (or wall seconds) of a call that waits for its result, which comes
    with them; the first call is not counted."""
    clock = time.perf_counter if wall else time.process_time
    result, seconds = call(), []
    for _ in range(repeats):
        before = clock()
        result = call()
        seconds.append(clock() - before)
    return Times(statistics.median(seconds), min(seconds), max(seconds)), result


def memory(compiled: Any) -> float:
    """What a compiled program takes, [MB]."""
    plan = compiled.memory_analysis()
    return (plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes) / 1e6
