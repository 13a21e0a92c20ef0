"""Cells of a study: pure functions of their configuration, each kept in one file.

A cell is a frozen dataclass whose fields say what it is made from, other cells among them. Its key
is a hash of all of that, so a file that is there for a key is the result, and is not made again.
"""

import json
import os
import resource
import tempfile
import time
import zipfile
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

from r2s._util.files import source_hash, write_bytes
from r2s.study.environment import processor

FORMAT = "r2s-cell/1"
KEY_LENGTH = 16  # of a key in the name of a file, hexadecimal digits
METADATA = "about.json"  # among the files of a result
VERSIONS = {name: version(name) for name in ("r2s", "jax", "jaxlib", "numpy")}


@dataclass(frozen=True)
class Cell:
    """A part of a study. Its fields are numbers, strings, tuples of them and frozen dataclasses.

    - `kind`: a folder for cells of this class.
    - `settings`: the constants of its module that a result depends on, which are part of its key:
      else a result of other meshes would be taken for one of these.
    """

    kind: ClassVar[str] = ""
    settings: ClassVar[tuple[Any, ...]] = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """What people call it; need not be unique."""

    @property
    def compilation_group(self) -> str:
        """The group of the cell. Those of one group compile once, and run one after the other."""
        return self.kind

    @property
    def runs(self) -> int:
        """How many recordings it is about, which its time grows with (`r2s.study.durations`)."""
        return 1

    @abstractmethod
    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Write the result's files into the folder `out`, and return what is to be noted of it.

        The results of `dependencies` are in the study's `folder`. The same cell gives the same
        numbers.
        """

    @property
    def key(self) -> str:
        """A hash of the configuration and of the inputs, whose configurations are part of it, and
        of the settings of all these."""
        settings = [each.settings for each in with_dependencies([self])]
        text = f"{FORMAT} {VERSIONS['r2s']} {self!r} {settings!r}"
        return sha256(text.encode()).hexdigest()[:KEY_LENGTH]

    def path(self, folder: Path) -> Path:
        """Where its result is, or will be."""
        return folder / "cells" / self.kind / f"{self.name}-{self.key}.zip"

    def is_made(self, folder: Path) -> bool:
        """Whether its result is there, whole."""
        return zipfile.is_zipfile(self.path(folder))


def dependencies(cell: Cell) -> tuple[Cell, ...]:
    """The cells that a cell is made from: those in its fields."""
    values = [getattr(cell, field.name) for field in fields(cell)]
    parts = [part for value in values for part in (value if isinstance(value, tuple) else [value])]
    return tuple(dict.fromkeys(part for part in parts if isinstance(part, Cell)))


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


def execute(cell: Cell, folder: Path) -> None:
    """Make the result of a cell, unless it is there; raises what `make` and writing raise."""
    path = cell.path(folder)
    if cell.is_made(folder):
        return
    began, cpu_began = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory(prefix="r2s-") as scratch:
        noted = cell.make(folder, Path(scratch))
        metadata = {
            "format": FORMAT,
            "key": cell.key,
            "kind": cell.kind,
            "name": cell.name,
            "config": repr(cell),
            "versions": VERSIONS,
            "source": source_hash()[:KEY_LENGTH],
            "processor": processor(),
            "seconds": time.perf_counter() - began,
            "cpu_seconds": time.process_time() - cpu_began,
            "peak_memory_MB": _peak_memory(),  # of the process so far
            **noted,
        }
        packed = _pack(Path(scratch), metadata)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, packed)


def read_metadata(cell: Cell, folder: Path) -> dict[str, Any]:
    """What was noted of a cell that is made: configuration, versions, times, memory, divergence."""
    with zipfile.ZipFile(cell.path(folder)) as packed:
        return json.loads(packed.read(METADATA))


@contextmanager
def result_files(cell: Cell, folder: Path) -> Iterator[Path]:
    """A folder with the files of a cell that is made, for as long as the context lasts.

    Raises `FileNotFoundError` when it is not made, and `zipfile.BadZipFile` when it is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="r2s-") as scratch:
        with zipfile.ZipFile(cell.path(folder)) as packed:
            packed.extractall(scratch)
        yield Path(scratch)


def _pack(scratch: Path, metadata: dict[str, Any]) -> bytes:
    (scratch / METADATA).write_text(json.dumps(metadata, indent=2) + "\n", encoding="utf-8")
    whole = scratch / ".whole.zip"
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as packed:
        for file in sorted(scratch.iterdir()):
            if file != whole:
                packed.write(file, file.name)
    return whole.read_bytes()


def _peak_memory() -> float:
    scale = 1e6 if os.uname().sysname == "Darwin" else 1e3  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale
