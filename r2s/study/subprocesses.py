"""One cell after the other, in a process of its own that has a worker's environment."""

import os
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

from r2s.study.cells import Cell
from r2s.study.engine import Serial, attempt
from r2s.study.environment import begin_worker, environment

TRIES = 2  # of a cell whose process died


class OneProcess(Serial):
    """Make cells as `Serial` does, but with the same numbers as workers.

    Linear algebra is threaded as the environment said when it was loaded, and sums in another
    order are other numbers.
    """

    def __init__(self) -> None:
        super().__init__()
        os.environ.update(environment(1))  # the process inherits it
        self._pool = self._start()

    def make(self, cell: Cell, folder: Path) -> str:
        reason = ""
        for _ in range(TRIES):
            try:
                return self._pool.submit(attempt, cell, folder, cell.key).result()
            except BrokenProcessPool as error:
                reason = f"{type(error).__name__}: {error}"
                self._pool = self._start()
        return reason

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=begin_worker)
