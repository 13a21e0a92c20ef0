"""Tasks of a study: pure functions of their configuration, each with one file as its result.

A task is a frozen dataclass. Its fields say what it is made from, other tasks among them; its key
is a hash of all of these. A file with that key is the result, and is not made again.
"""

import io
import json
import os
import platform
import resource
import tempfile
import time
import zipfile
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

from r2s import compilation
from r2s._util.files import source_hash, write_bytes

FORMAT, FOLDER = "r2s-cell/1", "cells"  # files and folders of results call a task a cell
KEY_LENGTH = 16  # hexadecimal digits of a key in a file's name
METADATA = "about.json"  # among the files of a result
MOST_MEMORY = 0.9e9  # [byte]: a process that holds more after a task clears its programs
VERSIONS = {name: version(name) for name in ("r2s", "jax", "jaxlib", "numpy")}


@dataclass(frozen=True)
class Task:
    """A part of a study. Its fields are numbers, strings, tuples of them and frozen dataclasses.

    - `kind`: the folder of results of this class.
    - `settings`: constants of the module that a result depends on; they are part of the key.
    """

    kind: ClassVar[str] = ""
    settings: ClassVar[tuple[Any, ...]] = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """A readable name; need not be unique."""

    @property
    def compilation_group(self) -> str:
        """Tasks of one group share their compiled programs, and run one after the other."""
        return self.kind

    @property
    def runs(self) -> int:
        """The number of recordings, to which the expected time is proportional."""
        return 1

    @abstractmethod
    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Write the result's files into the folder `out`, and return metadata.

        The results of `dependencies` are in the study's `folder`. The same task gives the same
        numbers.
        """

    @property
    def key(self) -> str:
        """A hash of all fields, and of the settings of this task and its dependencies."""
        settings = [task.settings for task in with_dependencies([self])]
        text = f"{FORMAT} {VERSIONS['r2s']} {self!r} {settings!r}"
        return sha256(text.encode()).hexdigest()[:KEY_LENGTH]

    def path(self, folder: Path) -> Path:
        """The file of the result."""
        return folder / FOLDER / self.kind / f"{self.name}-{self.key}.zip"

    def is_made(self, folder: Path) -> bool:
        """Whether the complete result exists."""
        return zipfile.is_zipfile(self.path(folder))


def dependencies(task: Task) -> tuple[Task, ...]:
    """The tasks in the fields of a task."""
    values = [getattr(task, field.name) for field in fields(task)]
    parts = [part for value in values for part in (value if isinstance(value, tuple) else [value])]
    return tuple(dict.fromkeys(part for part in parts if isinstance(part, Task)))


def with_dependencies(tasks: Iterable[Task]) -> list[Task]:
    """Tasks and all their dependencies, dependencies first."""
    ordered: dict[Task, None] = {}

    def visit(task: Task) -> None:
        if task not in ordered:
            for dependency in dependencies(task):
                visit(dependency)
            ordered[task] = None

    for task in tasks:
        visit(task)
    return list(ordered)


def execute(task: Task, folder: Path) -> None:
    """Make the result of a task, unless it exists; raises what `make` and writing raise."""
    if task.is_made(folder):
        return
    began, cpu_began = time.perf_counter(), time.process_time()
    unit = 1e6 if os.uname().sysname == "Darwin" else 1e3  # bytes there, kilobytes elsewhere
    packed = io.BytesIO()
    with tempfile.TemporaryDirectory(prefix="r2s-") as scratch:
        noted = task.make(folder, Path(scratch))
        metadata = {
            "format": FORMAT,
            "key": task.key,
            "kind": task.kind,
            "name": task.name,
            "config": repr(task),
            "versions": VERSIONS,
            "source": source_hash()[:KEY_LENGTH],
            "processor": processor(),
            "seconds": time.perf_counter() - began,
            "cpu_seconds": time.process_time() - cpu_began,
            "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
            **noted,
        }
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(METADATA, json.dumps(metadata, indent=2) + "\n")
            for file in sorted(Path(scratch).iterdir()):
                archive.write(file, file.name)
    task.path(folder).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(task.path(folder), packed.getvalue())


def attempt(task: Task, folder: Path, key: str | None = None, *needs: str) -> str:
    """Run a task; return why it failed, or "".

    - `key`: the task's key in the calling process, which may have another version of r2s.
    - `needs`: what this returned for the dependencies; Dask waits for them.
    """
    if key not in (None, task.key):
        return "a worker has another version of r2s: install the same everywhere"
    if not all(dependency.is_made(folder) for dependency in dependencies(task)):
        return "a dependency is missing"
    try:
        execute(task, folder)
    except Exception as error:  # whatever it is, the other tasks are still run
        return f"{type(error).__name__}: {error}"
    finally:
        compilation.clear_beyond(MOST_MEMORY)
    return ""


def read_metadata(task: Task, folder: Path) -> dict[str, Any]:
    """Configuration, versions, times, memory and divergence of a finished task."""
    with zipfile.ZipFile(task.path(folder)) as packed:
        return json.loads(packed.read(METADATA))


@contextmanager
def result_files(task: Task, folder: Path) -> Iterator[Path]:
    """A temporary folder with the files of a finished task.

    Raises `FileNotFoundError` when there is no result, and `zipfile.BadZipFile` when it is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="r2s-") as scratch:
        with zipfile.ZipFile(task.path(folder)) as packed:
            packed.extractall(scratch)
        yield Path(scratch)


def provenance(tasks: Iterable[Task], folder: Path) -> dict[str, int]:
    """How many of the finished tasks and their dependencies were made by which versions, source and
    processor, in words; the most first. More than one entry is a study of mixed origin."""
    counts: Counter[str] = Counter()
    for task in with_dependencies(tasks):
        if task.is_made(folder):
            noted = read_metadata(task, folder)
            versions = ", ".join(f"{name} {number}" for name, number in noted["versions"].items())
            counts[f"{versions}; source {noted['source']}; {noted['processor']}"] += 1
    return dict(counts.most_common())


def processor() -> str:
    """The processor's name, or its architecture where the system does not say."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
