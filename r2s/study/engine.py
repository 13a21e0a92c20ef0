"""Runs the cells of a study in the order of their dependencies, here or on workers.

Nothing that is finished is lost: a result is there whole or not at all, a cell that fails does not
stop the others, and a run that was killed goes on where it was.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from graphlib import TopologicalSorter
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol, runtime_checkable

from tqdm import tqdm

from r2s.compilation import clear_beyond
from r2s.study.cells import Cell, dependencies, execute, with_dependencies
from r2s.study.durations import expected_seconds, in_words
from r2s.study.environment import begin_worker, environment
from r2s.study.progress import progress

MOST_MEMORY = 0.9e9  # [byte]: a process that holds more after a cell lets its programs go
TRIES = 2  # of a cell whose process died


@runtime_checkable
class Runner(Protocol):
    """What makes cells: here one after the other, or elsewhere many at once."""

    @property
    def processes(self) -> int:
        """How many cells are made at once."""
        ...

    def submit(self, cell: Cell, folder: Path) -> None:
        """Take a cell whose dependencies are made."""
        ...

    def finished(self) -> Iterator[tuple[Cell, str]]:
        """Yield each cell when it is done, with why it failed, or "".

        Others may be submitted meanwhile. The iterator ends when none is left.
        """
        ...

    def close(self) -> None:
        """Release the workers."""
        ...


class Serial:
    """One cell after the other in this process, those that compile alike together."""

    processes = 1

    def __init__(self) -> None:
        self._waiting: list[tuple[Cell, Path]] = []

    def submit(self, cell: Cell, folder: Path) -> None:
        self._waiting.append((cell, folder))

    def finished(self) -> Iterator[tuple[Cell, str]]:
        last = ""
        while self._waiting:
            groups = [cell.compilation_group for cell, _ in self._waiting]
            cell, folder = self._waiting.pop(groups.index(last) if last in groups else 0)
            last = cell.compilation_group
            yield cell, self.make(cell, folder)

    def make(self, cell: Cell, folder: Path) -> str:
        """Make a cell and return why it failed, or ""."""
        return attempt(cell, folder)

    def close(self) -> None:
        pass


class OneProcess(Serial):
    """Make cells as `Serial` does, in a process of its own, with the same numbers as workers.

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


def attempt(cell: Cell, folder: Path, key: str | None = None) -> str:
    """Make a cell and return why it failed, or "".

    `key`: the cell's key in the process that asks, which may have another version of r2s.
    """
    if key not in (None, cell.key):
        return "a worker has another version of r2s: install the same everywhere"
    try:
        execute(cell, folder)
    except Exception as error:  # whatever it is, the other cells go on
        return f"{type(error).__name__}: {error}"
    finally:
        clear_beyond(MOST_MEMORY)
    return ""


def run(cells: Iterable[Cell], folder: Path, runner: Runner) -> dict[Cell, str]:
    """Make cells and what they need; return those that are missing at the end, with the reason.

    Cells that are made already are left alone, those that failed before are tried again.
    """
    waiting = [cell for cell in with_dependencies(cells) if not cell.is_made(folder)]
    seconds = expected_seconds(waiting)
    needs = {cell: [need for need in dependencies(cell) if need in seconds] for cell in waiting}
    failed: dict[Cell, str] = {}
    if not waiting:
        return failed
    order = TopologicalSorter(needs)
    order.prepare()
    total, processes = sum(seconds.values()), runner.processes
    print(
        f"study: {len(waiting)} cells, about {in_words(total / processes)} on {processes} "
        f"{'process' if processes == 1 else 'processes'}",
        file=sys.stderr,
        flush=True,
    )
    with progress(total, len(waiting), runner.processes) as bar:
        for cell in order.get_ready():
            runner.submit(cell, folder)
        for cell, reason in runner.finished():
            bar.update(seconds[cell])
            if reason:
                tqdm.write(f"missing: {cell.kind} {cell.name}: {reason}", file=sys.stderr)
                failed[cell] = reason
                continue
            order.done(cell)
            for other in order.get_ready():
                runner.submit(other, folder)
    for cell in waiting:  # what is needed comes first
        lost = [need for need in needs[cell] if need in failed]
        if lost:
            failed[cell] = f"needs {lost[0].kind} {lost[0].name}, which is missing"
    return failed
