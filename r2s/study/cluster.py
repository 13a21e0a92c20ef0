"""Workers for a study: processes of this machine, of a cluster, or whatever serves Dask.

Needs dask: pip install 'r2s[cluster]'.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from r2s.study.cells import Cell
from r2s.study.engine import attempt
from r2s.study.environment import begin_worker, environment

try:
    from dask import config
    from distributed import Client, LocalCluster, WorkerPlugin, as_completed
except ImportError as error:
    raise ImportError("workers need dask: pip install 'r2s[cluster]'") from error

RETRIES = 5  # of a cell whose worker died


def local(workers: int, compilation_cache: Path | None = None) -> "Workers":
    """Worker processes on this machine, one thread each."""
    if workers < 1:
        raise ValueError(f"at least one worker is needed, got {workers}")
    _configure(environment(workers, compilation_cache))
    cluster = LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0"
    )
    return Workers(_bound(cluster), cluster, workers)


def at(address: str) -> "Workers":
    """The workers of a scheduler that runs already, such as "tcp://node:8786"."""
    client = Client(address)
    return Workers(client, None, max(len(client.scheduler_info()["workers"]), 1))


def slurm(
    jobs: int, *, cores: int = 1, memory: str = "8GB", walltime: str = "04:00:00", queue: str = ""
) -> "Workers":
    """As many Slurm jobs, each of `cores` workers, which see the study's folder too.

    Needs dask-jobqueue. Partition, account and the like come from its configuration file. Raises
    `OSError` where there is no Slurm.
    """
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError as error:
        raise ImportError("Slurm needs dask-jobqueue: pip install 'r2s[cluster]'") from error
    if shutil.which("sbatch") is None:
        raise OSError("no command sbatch: submit from a node of the Slurm cluster")
    variables = environment(cores)
    _configure(variables)  # the scheduler runs here
    # the workers read their part of Dask's settings from their own environment
    variables |= {"DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "False"}
    exports = [f"export {name}='{value}'" for name, value in variables.items()]
    cluster = SLURMCluster(
        cores=cores,
        processes=cores,
        memory=memory,
        walltime=walltime,
        queue=queue or None,
        job_script_prologue=exports,
    )
    cluster.scale(jobs=jobs)
    return Workers(_bound(cluster), cluster, jobs * cores)


class OneCore(WorkerPlugin):
    """A core for each worker of a machine, by the number at the end of its name, and programs."""

    def setup(self, worker: Any) -> None:
        begin_worker(int(re.findall(r"\d+", str(worker.name))[-1]))


def _bound(cluster: Any) -> Client:
    client = Client(cluster)
    client.register_plugin(OneCore())
    return client


class Workers:
    """A `r2s.study.engine.Runner` on the workers of a Dask client.

    Cells that compile alike go to the same worker, as long as it is not busy.
    """

    def __init__(self, client: Any, cluster: Any, processes: int) -> None:
        self._client, self._cluster, self.processes = client, cluster, processes
        self._cells: dict[str, Cell] = {}
        self._homes: dict[str, int] = {}
        self._done = as_completed()

    def submit(self, cell: Cell, folder: Path) -> None:
        # asked of the scheduler: the client's own list is emptied by its refresh now and then.
        # None yet where jobs wait in a queue: then any worker will do.
        workers = sorted(self._client.nthreads())
        home = self._homes.setdefault(cell.compilation_group, len(self._homes))
        future = self._client.submit(
            attempt,
            cell,
            folder.absolute(),
            cell.key,
            key=f"{cell.kind}-{cell.key}",
            pure=False,
            retries=RETRIES,
            workers=[workers[home % len(workers)]] if workers else None,
            allow_other_workers=bool(workers),
        )
        self._cells[future.key] = cell
        self._done.add(future)

    def finished(self) -> Iterator[tuple[Cell, str]]:
        for future in self._done:
            cell = self._cells.pop(future.key)
            reason = future.result() if future.status == "finished" else _broken(future)
            yield cell, reason
            if not self._cells:
                return

    def close(self) -> None:
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


def _configure(variables: dict[str, str]) -> None:
    """Set what Dask gives to the processes that it starts, before they import anything."""
    config.set({"distributed.nanny.pre-spawn-environ": variables})
    config.set({"distributed.worker.multiprocessing-method": "spawn"})
    config.set({"distributed.scheduler.allowed-failures": RETRIES})
    config.set({"distributed.worker.memory.terminate": False})  # JAX keeps what it compiled


def _broken(future: Any) -> str:
    error = future.exception()
    return f"{type(error).__name__}: {error}"
