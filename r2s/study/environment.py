"""What a process that makes cells has in its environment, before JAX looks at it."""

import os
from pathlib import Path

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def one_thread(flags: str) -> str:
    """XLA's flags, with one thread: sheets are too small for more, and on a busy machine the
    threads of a step wait for each other many times longer than they compute."""
    return flags if ONE_THREAD in flags else f"{flags} {ONE_THREAD}".strip()


def environment(workers: int, compilation_cache: Path | None = None) -> dict[str, str]:
    """What a worker's environment holds before it imports JAX, for so many on a machine.

    One thread each: sums in another order would give other numbers, and a study is to have the same
    on any runner. All of them share the memory of its GPUs, if there are any; a fabric that goes
    wrong in a batch does not stop the others. Compiled programs are kept in `compilation_cache`.
    """
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    found = one | {
        "XLA_FLAGS": one_thread(os.environ.get("XLA_FLAGS", "")),
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / workers:.3f}",
        "EQX_ON_ERROR": "nan",
    }
    if compilation_cache is not None:
        found |= {"JAX_COMPILATION_CACHE_DIR": str(compilation_cache)}
    return found
