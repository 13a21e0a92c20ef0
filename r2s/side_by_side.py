"""Independent calls of compiled programs on threads, as many as this process has cores.

A compiled program lets other threads run, and a sheet is too small for several cores to share one:
two motions on 9 x 9 vertices side by side take half as long as one after the other.
"""

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import jax

Item = TypeVar("Item")
Found = TypeVar("Found")


class _Inside(threading.local):
    already = False


_inside = _Inside()


def side_by_side(function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
    """What a function gives of each item, in their order.

    One after the other on other devices than a CPU, on a single core, and within such a call.
    Precision is that of the calling thread. An error of one call is raised when all others that
    had begun are done.

    >>> side_by_side(abs, [-1, 2, -3])
    [1, 2, 3]
    """
    items = list(items)
    threads = min(cores(), len(items))
    if threads < 2 or _inside.already or jax.default_backend() != "cpu":
        return [function(item) for item in items]
    is_double = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]

    def call(item: Item) -> Found:
        _inside.already = True
        with jax.enable_x64(is_double):
            return function(item)

    with ThreadPoolExecutor(threads) as pool:
        running = [pool.submit(call, item) for item in items]
        try:
            return [each.result() for each in running]
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def meanwhile(calls: Iterable[Callable[[], Any]]) -> Iterator[None]:
    """Calls on a thread of their own, one after the other, while the body of a `with` runs.

    For what the body will wait for otherwise, such as a program to compile. Those that have not
    begun at its end are left out, and errors too: the body meets them itself. On a single core
    there are none.
    """
    if cores() < 2:
        yield
        return
    is_double = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]

    def make(call: Callable[[], Any]) -> None:
        with jax.enable_x64(is_double):
            call()

    pool = ThreadPoolExecutor(1)
    for call in calls:
        pool.submit(make, call)
    try:
        yield
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
