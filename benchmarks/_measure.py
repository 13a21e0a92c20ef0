"""Times of calls and memory of programs; tables are those of `experiments/_tables.py`."""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "experiments"))
from _tables import Line, command_line, keep  # noqa: E402

__all__ = ["Line", "command_line", "keep", "memory", "timed"]


def timed(call: Callable[[], Any], repeats: int, wall: bool = False) -> tuple[float, Any]:
    """Median CPU seconds of all threads (or wall seconds) of a call that waits for its result,
    which comes with them; the first call is not counted."""
    clock = time.perf_counter if wall else time.process_time
    result, seconds = call(), []
    for _ in range(repeats):
        before = clock()
        result = call()
        seconds.append(clock() - before)
    return statistics.median(seconds), result


def memory(compiled: Any) -> float:
    """What a compiled program takes, [MB]."""
    plan = compiled.memory_analysis()
    return (plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes) / 1e6
