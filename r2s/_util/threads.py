"""Independent calls of compiled programs on threads, as many as this process has cores.

A compiled program lets other threads run, and a sheet is too small for several cores to share one:
two motions on 9 x 9 vertices side by side take little more than half as long as one by one. The
variable `R2S_THREADS` of the environment is a limit.

No such program may factor matrices in batches (`jax.vmap` of `jnp.linalg.solve`): in jaxlib 0.10.1
these occupy a thread of its pool while they wait for others of it, so two of them side by side may
wait for ever.
"""

import contextvars
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import jax

Item = TypeVar("Item")
Found = TypeVar("Found")
LIMIT, POOL = "R2S_THREADS", "NPROC"
# of JAX, that a thread may have of its own
SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_disable_jit",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_platforms",
)


class _Inside(threading.local):
    already = False


_inside = _Inside()


def thread_map(
    function: Callable[[Item], Found],
    items: Iterable[Item],
    done: Callable[[int], None] | None = None,
) -> list[Found]:
    """What a function gives of each item, in their order.

    One after the other on other devices than a CPU, on a single core, within such a call, and where
    JAX has settings of the calling thread alone (`with jax.debug_nans(True)`). An error of one call
    is raised when all others that had begun are done.

    `done`: told in the calling thread how many of the first results are there.

    >>> thread_map(abs, [-1, 2, -3])
    [1, 2, 3]
    """
    items, found = list(items), []
    count = 1 if _inside.already else min(threads(), len(items))
    if count < 2 or jax.default_backend() != "cpu" or not _are_everywhere(settings()):
        results = map(function, items)
        return [_told(result, number, done) for number, result in enumerate(results, 1)]

    def call(item: Item) -> Found:
        _inside.already = True
        return function(item)

    with ThreadPoolExecutor(count) as pool:
        running = [pool.submit(contextvars.copy_context().run, call, item) for item in items]
        try:
            for number, each in enumerate(running, 1):
                found.append(_told(each.result(), number, done))
        finally:
            pool.shutdown(cancel_futures=True)
    return found


def _told(result: Found, number: int, done: Callable[[int], None] | None) -> Found:
    if done is not None:
        done(number)
    return result


def cores() -> int:
    """How many cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def threads() -> int:
    """As many as there are `cores`, or fewer, as `R2S_THREADS` says.

    Raises `ValueError` for a limit that is no whole number from 1 on.
    """
    most = os.environ.get(LIMIT, "").strip()
    if most and not (most.isdecimal() and int(most) > 0):
        raise ValueError(f"{LIMIT} must be a whole number from 1 on, got {most!r}")
    return min(cores(), int(most)) if most else cores()


def one_at_a_time() -> None:
    """Have XLA use one thread, where no two programs run side by side; before JAX's first number.

    On more it shares out loops of microseconds: on two a motion of 13 x 17 vertices takes 1.4 times
    as long, and 1.9 times the CPU time. In jaxlib 0.10.1 the size of its pool is the variable
    `NPROC` of the environment, which stays if it is set; intra_op_parallelism_threads in XLA_FLAGS
    does nothing.
    """
    os.environ.setdefault(POOL, "1")


def settings() -> tuple:
    """JAX's `SETTINGS` of this thread."""
    return tuple(getattr(jax.config, name, None) for name in SETTINGS)


def _are_everywhere(here: tuple) -> bool:
    """Whether a new thread has these settings."""
    found: list[tuple] = []
    thread = threading.Thread(target=lambda: found.append(settings()))
    thread.start()
    thread.join()
    return found == [here]


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
