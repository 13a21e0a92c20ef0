"""Runs the cells of a study in the order of their needs, here or on workers.

Nothing that is finished is lost: a result is there whole or not at all, a cell that fails does not
stop the others, and a run that was killed goes on where it was.
"""

import sys
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

from tqdm import tqdm

from r2s.study.cells import Cell, execute


@runtime_checkable
class Runner(Protocol):
    """What makes cells: here one after the other, or elsewhere many at once."""

    def submit(self, cell: Cell, folder: Path) -> None:
        """Take a cell whose needs are made."""
        ...

    def finished(self) -> Iterator[tuple[Cell, str]]:
        """Each cell when it is done, with why it failed, or "". Others may be submitted meanwhile;
        ends when none is left."""
        ...

    def close(self) -> None:
        """Give back workers."""
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
            alike = (i for i, (cell, _) in enumerate(self._waiting) if cell.alike == self._last)
            index = next(alike, 0)
            cell, folder = self._waiting[index]
            del self._waiting[index]
            self._last = cell.alike
            yield cell, self.make(cell, folder)

    def make(self, cell: Cell, folder: Path) -> str:
        """Why it failed, or ""."""
        return attempt(cell, folder)

    def close(self) -> None:
        pass


def attempt(cell: Cell, folder: Path, key: str | None = None) -> str:
    """Make a cell; why it failed, or "". `key`: what it is to the caller, who may be elsewhere."""
    if key not in (None, cell.key):
        return "a worker has another version of r2s: install the same everywhere"
    try:
        execute(cell, folder)
    except Exception as error:  # whatever it is, the other cells go on
        return f"{type(error).__name__}: {error}"
    return ""


def with_dependencies(cells: Iterable[Cell]) -> list[Cell]:
    """The cells and all that they need, what is needed first."""
    found: dict[Cell, None] = {}

    def visit(cell: Cell) -> None:
        if cell not in found:
            for need in dependencies(cell):
                visit(need)
            found[cell] = None

    for cell in cells:
        visit(cell)
    return list(found)


def run(cells: Iterable[Cell], folder: Path, runner: Runner) -> dict[Cell, str]:
    """Make the cells and what they need; those that are missing at the end, each with its reason.

    Those that are made already are left alone, those that failed before are tried again.
    """
    waiting = {cell: None for cell in with_dependencies(cells) if not cell.is_made(folder)}
    wanting = {cell: {need for need in dependencies(cell) if need in waiting} for cell in waiting}
    dependents = defaultdict(list)
    for cell, missing in wanting.items():
        for need in missing:
            dependents[need].append(cell)
    failed: dict[Cell, str] = {}
    shape = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}, about {remaining} left{postfix}"
    total = sum(cell.weight for cell in waiting)
    with tqdm(total=total, desc="study", bar_format=shape, disable=None, smoothing=0.1) as bar:
        for cell in waiting:
            if not wanting[cell]:
                runner.submit(cell, folder)
        for cell, reason in runner.finished() if waiting else ():
            bar.update(cell.weight)
            bar.set_postfix_str(f"{cell.kind} {cell.name}")
            if reason:
                tqdm.write(f"missing: {cell.kind} {cell.name}: {reason}", file=sys.stderr)
                _give_up(cell, reason, dependents, failed)
                continue
            for other in dependents[cell]:
                wanting[other].discard(cell)
                if not wanting[other] and other not in failed:
                    runner.submit(other, folder)
    return failed


def _give_up(cell: Cell, reason: str, dependents, failed: dict[Cell, str]) -> None:
    """Note that a cell failed, and all that need it."""
    failed[cell] = reason
    for other in dependents[cell]:
        if other not in failed:
            _give_up(other, f"needs {cell.kind} {cell.name}, which is missing", dependents, failed)
