"""What a process that makes cells has in its environment, before JAX looks at it."""

import os
import platform
from importlib.metadata import version
from pathlib import Path

from r2s import compilation
from r2s._util.extras import require
from r2s._util.threads import LIMIT

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
# Compiles a step in 60 to 70 % of the time, and it runs as fast. XLA ends a process whose flags it
# does not know: only releases that do are asked.
COMPILE_FAST, KNOWN_TO = "--xla_cpu_use_fusion_emitters=false", "0.10."
JAX_LEVEL = "1"  # of XLA's messages: JAX sets it where it is not set
LOOK = 0.1  # [s], to see which core is idle


def one_thread(flags: str) -> str:
    """XLA's flags, with linear algebra in one thread, since sheets are too small for more, and
    with less work for the compiler.

    XLA reads no further than the last word, so what is there comes first.
    """
    if ONE_THREAD in flags:
        return flags
    is_known = version("jaxlib").startswith(KNOWN_TO) and "fusion_emitters" not in flags
    parts = [flags, COMPILE_FAST if is_known else "", ONE_THREAD]
    return " ".join(part for part in parts if part)


def one_core(number: int | None = None) -> None:
    """Bind this process to one of its cores: by a number, or the idlest.

    Before JAX begins, which makes as many threads as it then has cores: those of several processes
    would wait for each other. Only Linux can bind processes; elsewhere nothing is done.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    if number is None:
        psutil = require("psutil", "cli", "the search for an idle core")
        busy = dict(enumerate(psutil.cpu_percent(interval=LOOK, percpu=True)))
        # some containers show their cores' times under other numbers
        number = min(range(len(cores)), key=lambda i: busy.get(cores[i], 0.0))
    os.sched_setaffinity(0, {cores[number % len(cores)]})


def begin_worker(number: int | None = None) -> None:
    """What a process that makes cells does first: it binds itself and keeps its programs."""
    one_core(number)
    compilation.keep()


def environment(workers: int, compilation_cache: Path | None = None) -> dict[str, str]:
    """What a worker's environment holds before it imports JAX, for so many on a machine.

    One thread each: sums in another order would give other numbers, and a study is to have the same
    on any runner. All of them share the memory of its GPUs, if there are any; a fabric that goes
    wrong in a batch does not stop the others. Compiled programs are kept in `compilation_cache`,
    by default where `r2s.compilation.keep` has them.
    """
    level = os.environ.get("TF_CPP_MIN_LOG_LEVEL", JAX_LEVEL)
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    found = one | {
        LIMIT: "1",
        "XLA_FLAGS": one_thread(os.environ.get("XLA_FLAGS", "")),
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / workers:.3f}",
        "EQX_ON_ERROR": "nan",
        "TF_CPP_MIN_LOG_LEVEL": "3" if level == JAX_LEVEL else level,  # see `r2s.__main__`
    }
    if compilation_cache is not None:
        found |= {"JAX_COMPILATION_CACHE_DIR": str(compilation_cache)}
    return found


def processor() -> str:
    """The processor's name, [-]; that of its architecture where the system tells no more."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
