"""Whether what is about to run fits the memory that is there."""

import os
from pathlib import Path
from typing import Any

import jax

MEMINFO = Path("/proc/meminfo")


def available() -> int | None:
    """Free memory [byte] of the first device, on a CPU that of the machine; None: nobody says."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return None if limit is None else limit - stats.get("bytes_in_use", 0)
    if MEMINFO.exists():  # on Linux, which counts what it would give back
        lines = [line.split() for line in MEMINFO.read_text().splitlines()]
        return next((1024 * int(line[1]) for line in lines if line[0] == "MemAvailable:"), None)
    if "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def check(needed: float | int, what: str, advice: str) -> None:
    """Raise `MemoryError` with advice when `what` needs more memory [byte] than there is."""
    there = available()
    if there is not None and needed > there:
        raise MemoryError(
            f"{what} needs {needed / 1e9:.3g} GB, {there / 1e9:.3g} GB are free: {advice}"
        )


def planned(compiled: Any) -> int:
    """Memory [byte] of arguments, results and all between, as the compiler lays a program out.

    Raises `RuntimeError` where a backend's compiler does not say.
    """
    plan = compiled.memory_analysis()
    if plan is None:
        raise RuntimeError("this backend's compiler does not say how much memory a program needs")
    return plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes
