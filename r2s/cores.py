"""Cores for what is compiled beside a computation that keeps to one core (Linux alone)."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

COMPILE_ON = "R2S_COMPILE_ON"  # environment: numbers of cores, such as "0,1"; not set: stay


@contextmanager
def compiling() -> Iterator[None]:
    """All threads of this process on the cores of `COMPILE_ON`, and then where this one was.

    XLA compiles in threads of its own, which were bound when they began. They go back, since
    threads of a computation that wait for each other spin.
    """
    cores = {int(number) for number in os.environ.get(COMPILE_ON, "").split(",") if number}
    if not cores or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    _bind(cores)
    try:
        yield
    finally:
        _bind(before)


def _bind(cores: Iterable[int]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread.name), cores)
