"""Compiled programs, kept in files between processes.

Most of what a short command takes is compilation. `keep` lets JAX write what it compiled to the
user's cache folder and read it from there; tracing and lowering remain.

JAX's own files are neither written whole nor checked, and it never replaces one that is damaged. So
the folder is of `Programs`: a file has a checksum before its program, is renamed into place, and is
removed where it is damaged; the oldest go when all are too large. Any number of processes may share
it. Who can write there can have this process run what they like: the folder must be the user's own.
"""

import hashlib
import os
import platform
import stat
import sys
import tempfile
import warnings
from pathlib import Path

import jax

from r2s.side_by_side import cores

SUFFIX = ".program"
MOST = 1_000_000_000  # [byte] of all programs: some hundred motions with their gradients
HEADER = hashlib.sha256().digest_size  # [byte]
FOLDER, ENABLED = "jax_compilation_cache_dir", "jax_enable_compilation_cache"


class Programs:
    """The cache of a folder, as JAX asks for one.

    - `folder`: where the files are. - `most`: size of all files together, [byte].

    Raises `OSError` when the folder can't be made or written, or others can write it.
    """

    def __init__(self, folder: Path, most: int = MOST) -> None:
        self._path, self._most, self._full = folder, most, False
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_owner(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass

    def get(self, key: str) -> bytes | None:
        """A program; None where there is none, or a damaged one, which is removed."""
        file = self._file(key)
        try:
            content = file.read_bytes()
        except OSError:
            return None
        digest, program = content[:HEADER], content[HEADER:]
        if hashlib.sha256(program).digest() != digest:
            file.unlink(missing_ok=True)
            return None
        try:
            os.utime(file)  # the last use, by which the oldest go
        except OSError:  # another process removed it
            pass
        return program

    def put(self, key: str, value: bytes) -> None:
        """Write a program, whole or not at all, and make room for it.

        Warns once, and writes nothing from then on, when the folder does not take it.
        """
        if self._full or len(value) > self._most:
            return
        try:
            self._make_room(len(value))
            _write(self._file(key), hashlib.sha256(value).digest() + value)
        except OSError as error:
            self._full = True
            warnings.warn(f"compiled programs are not kept any more: {error}", stacklevel=2)

    def clear(self) -> None:
        """Remove all programs."""
        for file in self._path.glob(f"*{SUFFIX}"):
            file.unlink(missing_ok=True)

    def _file(self, key: str) -> Path:
        return self._path / f"{key}{SUFFIX}"

    def _make_room(self, size: int) -> None:
        files = []
        for file in self._path.glob(f"*{SUFFIX}"):
            try:
                found = file.stat()
            except FileNotFoundError:  # another process removed it
                continue
            files.append((found.st_mtime, found.st_size, file))
        total = size + sum(each for _, each, _ in files)
        for _, each, file in sorted(files):
            if total <= self._most:
                return
            file.unlink(missing_ok=True)
            total -= each


def keep(folder: Path | None = None, most: int = MOST) -> Path | None:
    """Keep the programs that this process compiles from now on; the folder, or None.

    - `folder`: by default that of JAX_COMPILATION_CACHE_DIR, or else `user_folder`.
    - `most`: of all programs together, [byte].

    Nothing is kept where JAX_ENABLE_COMPILATION_CACHE says so, and, with a warning, where the
    folder can't be written.
    """
    from jax._src import compilation_cache  # there is no public way to bring a cache of one's own

    if not getattr(jax.config, ENABLED):
        return None
    folder = Path(folder or getattr(jax.config, FOLDER) or user_folder()) / machine()
    try:
        programs = Programs(folder, most)
    except OSError as error:
        forget()
        warnings.warn(
            f"compiled programs are not kept: {error}. Name another folder by "
            "JAX_COMPILATION_CACHE_DIR, or say --no-cache",
            stacklevel=2,
        )
        return None
    compilation_cache.reset_cache()
    compilation_cache.get_file_cache = lambda path: (programs, path)  # pyright: ignore
    jax.config.update(FOLDER, str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    _in_use.append(programs)
    return folder


def kept() -> Programs | None:
    """Where this process keeps its programs; None: nowhere."""
    return _in_use[-1] if _in_use and getattr(jax.config, ENABLED) else None


_in_use: list[Programs] = []  # of this process, as JAX's own is


def forget() -> None:
    """Keep no programs from now on, and read none: here, and in processes that begin from here."""
    jax.config.update(ENABLED, False)
    os.environ[ENABLED.upper()] = "false"


def user_folder() -> Path:
    """The folder of this user for what can be made again, by the rules of the platform."""
    if sys.platform == "win32":
        caches = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        caches = Path.home() / "Library" / "Caches"
    else:
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "r2s" / "programs"


def machine() -> str:
    """A name for what programs are compiled for: the processor, what it can do, and how many cores.

    A program for two cores that runs on one waits for itself: a lift takes 20 times as long.

    A home folder may be shared by machines that do not understand each other's programs.
    """
    told = [platform.machine(), platform.system(), f"{cores()} cores"]
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux: the machine's own name
        told += [platform.processor(), platform.node()]
    else:
        names = ("model name", "flags", "Features", "CPU part")
        told += sorted({line for line in lines if line.startswith(names)})
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:12]


def _check_owner(folder: Path) -> None:
    if not hasattr(os, "getuid"):  # Windows: a user's folders are closed to others
        return
    found = folder.stat()
    if found.st_uid != os.getuid() or found.st_mode & stat.S_IWOTH:
        raise PermissionError(f"{folder}: others can write it, and programs are run as they are")


def _write(file: Path, content: bytes) -> None:
    number, name = tempfile.mkstemp(dir=file.parent, suffix=SUFFIX)  # one left behind goes, too
    try:
        with os.fdopen(number, "wb") as stream:
            stream.write(content)
        os.replace(name, file)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise
