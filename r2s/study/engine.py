"""Runs the tasks of a study in the order of their dependencies, with a forecast and progress.

Tasks run in this process, in one of its own, or on workers of Dask: processes of this machine, jobs
of Slurm, or whatever a scheduler serves. A result is written completely or not at all, a task that
fails does not stop the others, and a run that was killed continues where it was.
"""

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from r2s import compilation
from r2s._util.extras import require
from r2s._util.threads import LIMIT, POOL
from r2s.study.tasks import Task, attempt, dependencies, with_dependencies

# Compiles a step in 60 to 70 % of the time. XLA ends a process whose flags it does not know, so
# only releases that know it are given it.
COMPILE_FAST, KNOWN_TO = "--xla_cpu_use_fusion_emitters=false", "0.10."
JAX_LEVEL = "1"  # of XLA's messages, which JAX sets where it is not set
RETRIES = 5  # of a task whose process died, with Dask
JOB = {"cores": 1, "processes": 1, "memory": "8GB", "walltime": "04:00:00"}  # of Slurm
# CPU seconds of the first recording of a compilation group, with compilation, and of each further
# one; by the beginning of the group's name, the longest that fits. What "one_fabric" has is about
# what its run took from empty caches (two threads of one core); the others are guesses.
SECONDS: dict[str, tuple[float, float]] = {
    "": (1.0, 1.0),
    "networks cloth": (170.0, 170.0),
    "networks mpm": (150.0, 150.0),
    "recordings": (28.0, 20.0),
    "recordings of MuJoCo": (60.0, 60.0),
    "ensembles": (160.0, 110.0),
    "ensembles of MuJoCo": (200.0, 200.0),
    "estimates diffcloud": (560.0, 500.0),
    "estimates diffcloud cloth wind": (1070.0, 1000.0),
    "estimates diffcloud cloth lifting+": (1000.0, 800.0),
    "estimates diffcp": (130.0, 110.0),
    "estimates physnet": (45.0, 35.0),
    "estimates pinn": (70.0, 60.0),
    "evaluations": (20.0, 13.0),
}
LINES = 30.0  # [s] between lines of progress
# [s] that count as done at the expected pace, until finished tasks give a better estimate
TRUST = 300.0

Outcome = tuple[Task, str]  # why it failed, or ""


class Runner:
    """Runs tasks one after the other in this process; subclasses run `processes` at once."""

    processes: int = 1

    def run(self, tasks: Sequence[Task], folder: Path) -> Iterator[Outcome]:
        """Yield each task when it is done, with why it failed, or "".

        `tasks`: in an order in which dependencies come first.
        """
        for task in tasks:
            yield task, attempt(task, folder)

    def close(self) -> None:
        """Release the workers."""


def run(tasks: Iterable[Task], folder: Path, runner: Runner) -> dict[Task, str]:
    """Make tasks and their dependencies; return those that failed, with the reason.

    Existing results are left alone; tasks that failed before are tried again.
    """
    waiting = [task for task in _ordered(tasks) if not task.is_made(folder)]
    failed: dict[Task, str] = {}
    if not waiting:
        return failed
    seconds = expected_seconds(waiting)
    total, processes = sum(seconds.values()), runner.processes
    _say(
        f"study: {len(waiting)} cells, about {in_words(total / processes)} on {processes} "
        f"{'process' if processes == 1 else 'processes'}"
    )
    with progress(total, len(waiting), processes) as done:
        for task, reason in runner.run(waiting, folder):
            done.append(seconds[task])
            missing = [need for need in dependencies(task) if need in failed]
            if missing:
                failed[task] = f"needs {missing[0].kind} {missing[0].name}, which is missing"
            elif reason:
                _say(f"missing: {task.kind} {task.name}: {reason}")
                failed[task] = reason
    return failed


def _ordered(tasks: Iterable[Task]) -> list[Task]:
    """Tasks and their dependencies: first what the longest chain of tasks still waits for. Of equal
    ones those of a compilation group are together."""
    needed = list(with_dependencies(tasks))
    chain = dict.fromkeys(needed, 0.0)  # [CPU s] of what waits for a task, and then with it
    for task in reversed(needed):
        chain[task] += task.runs * _seconds(task)[1]
        for dependency in dependencies(task):
            chain[dependency] = max(chain[dependency], chain[task])
    return sorted(needed, key=lambda task: (-chain[task], task.compilation_group))


def expected_seconds(tasks: Iterable[Task]) -> dict[Task, float]:
    """The time of each task, [CPU s], when they are made in this order."""
    compiled: set[str] = set()
    seconds = {}
    for task in tasks:
        first, further = _seconds(task)
        is_first = task.compilation_group not in compiled
        seconds[task] = (first if is_first else further) + (task.runs - 1) * further
        compiled.add(task.compilation_group)
    return seconds


def _seconds(task: Task) -> tuple[float, float]:
    """Of the first recording of a task, with compilation, and of each further one, [CPU s]."""
    return SECONDS[max(filter(task.compilation_group.startswith, SECONDS), key=len)]


def in_words(seconds: float) -> str:
    """A time [s] in seconds, minutes or hours, such as "20 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.0f} h"


@contextmanager
def progress(seconds: float, count: int, processes: int) -> Iterator[list[float]]:
    """Progress on stderr while tasks run, a line each half minute.

    To the list that it yields the caller appends the expected time of each task that is done, of
    `seconds` in all, [CPU s].
    """
    done: list[float] = []
    began, stop = time.monotonic(), threading.Event()

    def show() -> None:
        while not stop.wait(LINES):
            elapsed, made = time.monotonic() - began, sum(done)
            pace = (TRUST + elapsed) / (TRUST + made / processes)
            left = pace * (seconds - made) / processes
            words = f"{in_words(elapsed)} elapsed, about {in_words(left)} left"
            _say(f"study of {count} cells: {100 * made / seconds:3.0f} %, {words}")

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield done
    finally:
        stop.set()
        thread.join()


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def compile_fast(flags: str) -> str:
    """XLA's flags with `COMPILE_FAST`, where the release knows it and they do not say otherwise."""
    is_known = version("jaxlib").startswith(KNOWN_TO) and "fusion_emitters" not in flags
    return f"{COMPILE_FAST} {flags}".strip() if is_known else flags


def environment(workers: int, compilation_cache: Path | None = None) -> dict[str, str]:
    """The environment of a worker before it imports JAX, for `workers` on one machine.

    Each has one thread, so that sums are in the same order on any runner, and a share of the GPUs'
    memory. Compiled programs are by default where `r2s.compilation.keep` has them.
    """
    level = os.environ.get("TF_CPP_MIN_LOG_LEVEL", JAX_LEVEL)
    ones = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", LIMIT, POOL)
    variables = dict.fromkeys(ones, "1") | {
        "XLA_FLAGS": compile_fast(os.environ.get("XLA_FLAGS", "")),
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / workers:.3f}",
        "EQX_ON_ERROR": "nan",
        "TF_CPP_MIN_LOG_LEVEL": "3" if level == JAX_LEVEL else level,  # see `r2s.__main__`
    }
    if compilation_cache is not None:
        variables["JAX_COMPILATION_CACHE_DIR"] = str(compilation_cache)
    return variables


class OneProcess(Runner):
    """Runs one task after the other in a process of its own, in the environment of workers, so that
    the numbers are the same."""

    def __init__(self) -> None:
        os.environ.update(environment(1))  # inherited by the process
        self._pool = self._start()

    def run(self, tasks: Sequence[Task], folder: Path) -> Iterator[Outcome]:
        for task in tasks:
            try:
                reason = self._pool.submit(attempt, task, folder, task.key).result()
            except BrokenProcessPool as error:
                reason = f"{type(error).__name__}: {error}"
                self._pool = self._start()
            yield task, reason

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=compilation.keep)


class DaskWorkers(Runner):
    """Runs tasks on the workers of a Dask client."""

    def __init__(self, client: Any, processes: int, cluster: Any = None) -> None:
        self.client, self.processes, self._cluster = client, processes, cluster

    def run(self, tasks: Sequence[Task], folder: Path) -> Iterator[Outcome]:
        from distributed import as_completed

        futures: dict[Task, Any] = {}
        for place, task in enumerate(tasks):
            needs = [futures[need] for need in dependencies(task) if need in futures]
            arguments = (task, folder.absolute(), task.key, *needs)
            options = {"pure": False, "retries": RETRIES, "priority": -place}
            futures[task] = self.client.submit(attempt, *arguments, **options)
        task_of = {future.key: task for task, future in futures.items()}
        for future in as_completed(list(futures.values())):
            if future.status == "finished":
                yield task_of[future.key], future.result()
            else:
                error = future.exception()
                yield task_of[future.key], f"{type(error).__name__}: {error}"

    def close(self) -> None:
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()


def local(workers: int, compilation_cache: Path | None = None) -> DaskWorkers:
    """Worker processes on this machine, one thread each."""
    distributed = require("distributed", "cluster", "several workers")
    _configure(environment(workers, compilation_cache))
    cluster = distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        preload=[__name__],
    )
    return DaskWorkers(distributed.Client(cluster), workers, cluster)


def at(address: str) -> DaskWorkers:
    """The workers of a running scheduler, such as "tcp://node:8786"."""
    client = require("distributed", "cluster", "workers of a scheduler").Client(address)
    return DaskWorkers(client, max(len(client.scheduler_info()["workers"]), 1))


def slurm(jobs: int) -> DaskWorkers:
    """As many Slurm jobs of one worker each, with the partition and account of dask-jobqueue's
    configuration file. Raises `OSError` where there is no Slurm."""
    jobqueue = require("dask_jobqueue.slurm", "cluster", "Slurm")
    distributed = require("distributed", "cluster", "Slurm")
    if shutil.which("sbatch") is None:
        raise OSError("no command sbatch: submit from a node of the Slurm cluster")
    variables = environment(1)
    _configure(variables)  # the scheduler runs here
    # the workers read their part of Dask's settings from their own environment
    variables |= {"DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "False"}
    exports = [f"export {name}='{value}'" for name, value in variables.items()]
    cluster = jobqueue.SLURMCluster(
        **JOB, job_script_prologue=exports, worker_extra_args=["--preload", __name__]
    )
    cluster.scale(jobs=jobs)
    return DaskWorkers(distributed.Client(cluster), jobs, cluster)


def _configure(variables: dict[str, str]) -> None:
    """Set what Dask gives to the processes that it starts, before they import anything."""
    require("dask", "cluster", "several workers").config.set(
        {
            "distributed.nanny.pre-spawn-environ": variables,
            "distributed.worker.multiprocessing-method": "spawn",
            "distributed.scheduler.allowed-failures": RETRIES,
            "distributed.worker.memory.terminate": False,  # JAX keeps what it compiled
        }
    )


def dask_setup(worker: Any) -> None:
    """Prepare a worker of Dask that preloads this module."""
    compilation.keep()
