"""Times, memory and tables of the benchmarks."""

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

Row = dict[str, Any]


def progress(text: str) -> None:
    """A line on stderr."""
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


def machine() -> Row:
    """What the figures depend on."""
    return {
        "cpus": os.cpu_count(),
        "used": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "machine": platform.machine(),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("jax", "mujoco", "newton", "warp-lang")},
        "device": jax.devices()[0].device_kind,
        "load": round(os.getloadavg()[0], 2),
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"


def keep_to(cores: int) -> None:
    """Start again on some cores only, since JAX counts them when it is imported. Linux only."""
    if not hasattr(os, "sched_setaffinity"):
        return
    allowed = sorted(os.sched_getaffinity(0))
    if 0 < cores < len(allowed):
        os.sched_setaffinity(0, allowed[-cores:])
        os.execv(sys.executable, [sys.executable, *sys.argv])


def clock_name() -> str:
    """Which seconds are compared: CPU seconds of all threads, or wall seconds beside a GPU."""
    return "cpu_s" if jax.default_backend() == "cpu" else "wall_s"


def built(build: Callable[[], Any]) -> tuple[Any, float]:
    """What `build` gives, set up and compiled, and the wall seconds that it took."""
    before = time.perf_counter()
    made = build()
    return made, time.perf_counter() - before


def timed(call: Callable[[], Any], repeats: int, budget: float) -> tuple[Row, Any]:
    """Medians and ranges of CPU (all threads) and wall seconds, and what the last call gave.

    It is called `repeats` times, or fewer when that takes more than `budget` [s], but at least
    once. The caller sees to it that a call has nothing left to compile and waits for its result.
    """
    cpu, wall = [], []
    while len(wall) < repeats and (not wall or sum(wall) < budget):
        cpu_before, before = time.process_time(), time.perf_counter()
        result = call()
        cpu.append(time.process_time() - cpu_before)
        wall.append(time.perf_counter() - before)
    row: Row = {"repeats": len(wall)}
    for name, seconds in (("cpu_s", cpu), ("wall_s", wall)):
        row[name] = statistics.median(seconds)
        row[f"{name}_min"], row[f"{name}_max"] = min(seconds), max(seconds)
    return row, result


def in_turn(calls: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """The least CPU seconds of each call, which take turns, so that all meet the same machine."""
    least = [float("inf")] * len(calls)
    for _ in range(repeats):
        for i, call in enumerate(calls):
            before = time.process_time()
            jax.block_until_ready(call())
            least[i] = min(least[i], time.process_time() - before)
    return least


def prefixed(prefix: str, row: Row) -> Row:
    """The row with its names changed."""
    return {f"{prefix}_{name}": value for name, value in row.items()}


def span(row: Row, name: str) -> str:
    """A median and its range, to print."""
    if name not in row:
        return "-"
    low, high = row[f"{name}_min"], row[f"{name}_max"]
    return f"{row[name]:.3g} ({low:.3g}..{high:.3g})"


def show(title: str, rows: Sequence[Row], columns: dict[str, Callable[[Row], str]]) -> None:
    """Print a table of columns (a heading, and the text of a row)."""
    cells = [list(columns), *([text(row) for text in columns.values()] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    print(f"\n{title}")
    for line in cells:
        padded = (text.ljust(width) for text, width in zip(line, widths, strict=True))
        print("  ".join(padded).rstrip())
    sys.stdout.flush()


def _status(name: str) -> float:
    """A figure of this process from Linux's /proc, in MB (10^6 bytes)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (kilobytes,) = [line.split()[1] for line in lines if line.startswith(name + ":")]
    return int(kilobytes) * 1024 / 1e6


def peak_memory(build: Callable[[], Callable[[], Any]]) -> Row:
    """Peak resident memory [MB] of this process so far, and what a call added to it. Linux only.

    - `process`: the whole process, with Python, libraries and compilation.
    - `built`: more than before `build`, at the peak of all.
    - `call`: more than after `build`, at the peak of the call.
    """
    before = _status("VmRSS")
    call = build()
    after, highest = _status("VmRSS"), _status("VmHWM")
    Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    call()
    peak = _status("VmHWM")
    return {
        "process_mb": max(highest, peak),
        "built_mb": max(highest, peak) - before,
        "call_mb": peak - after,
    }


def in_subprocess(arguments: Sequence[str]) -> Any:
    """The last line of a Python program's output, read as JSON."""
    done = subprocess.run([sys.executable, *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])
