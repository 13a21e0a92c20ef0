"""Runs the cells of a study in the order of their dependencies, here or on workers.

Nothing that is finished is lost: a result is there whole or not at all, a cell that fails does not
stop the others, and a run that was killed goes on where it was.
"""

import sys
from collections import deque
from collections.abc import Container, Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Protocol, runtime_checkable

from tqdm import tqdm

from r2s.compilation import clear_beyond
from r2s.study.cells import Cell, dependencies, execute, with_dependencies
from r2s.study.progress import progress

MOST_MEMORY = 0.9e9  # [byte]: a process that holds more after a cell lets its programs go


@runtime_checkable
class Runner(Protocol):
    """What makes cells: here one after the other, or elsewhere many at once."""

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

    def __init__(self) -> None:
        self._waiting: deque[tuple[Cell, Path]] = deque()
        self._last = ""

    def submit(self, cell: Cell, folder: Path) -> None:
        self._waiting.append((cell, folder))

    def finished(self) -> Iterator[tuple[Cell, str]]:
        while self._waiting:
            groups = [cell.compilation_group for cell, _ in self._waiting]
            index = groups.index(self._last) if self._last in groups else 0
            cell, folder = self._waiting[index]
            del self._waiting[index]
            self._last = cell.compilation_group
            yield cell, self.make(cell, folder)

    def make(self, cell: Cell, folder: Path) -> str:
        """Make a cell and return why it failed, or ""."""
        return attempt(cell, folder)

    def close(self) -> None:
        pass


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
    waiting = {cell: None for cell in with_dependencies(cells) if not cell.is_made(folder)}
    order = TopologicalSorter({cell: _waiting_for(cell, waiting) for cell in waiting})
    order.prepare()
    failed: dict[Cell, str] = {}
    total = sum(cell.weight for cell in waiting)
    with progress(total, len(waiting)) as bar:
        for cell in order.get_ready():
            runner.submit(cell, folder)
        for cell, reason in runner.finished() if waiting else ():
            bar.update(cell.weight)
            bar.set_postfix_str(f"{cell.kind} {cell.name}")
            if reason:
                tqdm.write(f"missing: {cell.kind} {cell.name}: {reason}", file=sys.stderr)
                failed[cell] = reason
                continue
            order.done(cell)
            for other in order.get_ready():
                runner.submit(other, folder)
    for cell in waiting:  # what is needed comes first
        lost = [need for need in _waiting_for(cell, waiting) if need in failed]
        if lost:
            failed[cell] = f"needs {lost[0].kind} {lost[0].name}, which is missing"
    return failed


def _waiting_for(cell: Cell, waiting: Container[Cell]) -> list[Cell]:
    return [need for need in dependencies(cell) if need in waiting]
