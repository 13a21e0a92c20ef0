"""Compiled programs: once for all threads of a process, and kept in files.

Most of what a short command takes is compilation. `keep` has JAX write what it compiles to the
user's cache folder, and read it from there; tracing and lowering remain. Who can write that folder
can have this process run what they like.
"""

import ctypes
import functools
import gc
import hashlib
import os
import platform
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from r2s._util.arrays import is_traced
from r2s._util.extras import require
from r2s._util.threads import cores, settings

MOST = 1_000_000_000  # [byte] of all programs in a folder: some hundred motions with gradients
SHORT = 0.1  # [s]: what compiles sooner is not kept
FOLDER, ENABLED = "jax_compilation_cache_dir", "jax_enable_compilation_cache"
MAPPED, MOST_MAPPED = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
SHARE = 0.5  # of the mappings that Linux allows, beyond which programs go


class Compiled:
    """A function of pytrees, compiled as by `equinox.filter_jit`, but once where two threads call
    it for the first time, and apart for numbers that are equal and of another type."""

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._jitted: dict[Any, Any] = {}  # by the types of static parts, which it does not look at
        self._ready: set[Any] = set()
        self._locks: dict[Any, threading.RLock] = {}  # of each program
        _all.add(self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        program, jitted = self._of(args, kwargs)
        if program in self._ready or is_traced(args, kwargs):
            return jitted(*args, **kwargs)
        with self._locks.setdefault(program, threading.RLock()):
            found = jitted(*args, **kwargs)
            self._ready.add(program)
            return found

    def _of(self, args: tuple, kwargs: dict) -> tuple[Any, Any]:
        """What tells one program from another, and what compiles it."""
        dynamic, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, tree = jax.tree.flatten(dynamic)
        shapes = tuple((leaf.shape, str(leaf.dtype), leaf.weak_type) for leaf in leaves)
        parts, static_tree = jax.tree.flatten(static)
        types = tuple(map(type, parts))
        jitted = self._jitted.get(types)
        if jitted is None:  # apart, as one function has the same programs wherever it is compiled
            jitted = eqx.filter_jit(functools.partial(self._function))
            jitted = self._jitted.setdefault(types, jitted)  # another thread's, if it was first
        return (tree, shapes, types, tuple(parts), static_tree, settings()), jitted


_all: weakref.WeakSet[Compiled] = weakref.WeakSet()


def compile_once(function: Callable) -> Compiled:
    """`Compiled`, as a decorator."""
    return Compiled(function)


def keep(folder: Path | None = None) -> Path | None:
    """Keep the programs that this process compiles from now on; the folder, or None.

    - `folder`: by default that of JAX_COMPILATION_CACHE_DIR, or else one of the user's cache
      folder. Those used longest ago go when all take more than `MOST`.

    Nothing is kept where JAX_ENABLE_COMPILATION_CACHE says so, and, with a warning, where the
    folder can't be written.
    """
    from jax.experimental.compilation_cache import compilation_cache

    platformdirs = require("platformdirs", "cli", "a folder for compiled programs")
    require("filelock", "cli", "a limit to what is kept")  # by JAX
    if not getattr(jax.config, ENABLED):
        return None
    usual = platformdirs.user_cache_path("r2s", appauthor=False) / "programs"
    folder = Path(folder or getattr(jax.config, FOLDER) or usual) / machine()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        forget()
        warnings.warn(
            f"compiled programs are not kept: {error}. Name another folder by "
            "JAX_COMPILATION_CACHE_DIR, or say --no-cache",
            stacklevel=2,
        )
        return None
    compilation_cache.reset_cache()
    jax.config.update(FOLDER, str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORT)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def is_kept() -> bool:
    """Whether this process keeps its programs by `keep`, in a folder of this machine."""
    folder = getattr(jax.config, FOLDER)
    return bool(getattr(jax.config, ENABLED) and folder) and Path(folder).name == machine()


def forget() -> None:
    """Keep no programs from now on, and read none: here, and in processes that begin from here."""
    jax.config.update(ENABLED, False)
    os.environ[ENABLED.upper()] = "false"


def machine() -> str:
    """A name for what programs are compiled for: the processor, what it can do, and how many cores.

    A program for two cores that runs on one waits for itself: a lift takes 20 times as long. A home
    folder may be shared by machines that do not understand each other's programs.
    """
    parts = [platform.machine(), platform.system(), f"{cores()} cores"]
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux: the machine's own name
        parts += [platform.processor(), platform.node()]
    else:
        names = ("model name", "flags", "Features", "CPU part")
        parts += sorted({line for line in lines if line.startswith(names)})
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def clear() -> None:
    """Let all compiled programs of this process go, and give their memory back."""
    for each in _all:
        each._jitted.clear()
        each._ready.clear()
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # what was freed goes back to the system
        malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc alone
        if malloc_trim is not None:
            malloc_trim(0)


def clear_beyond(most: float) -> None:
    """`clear` if this process holds more memory than `most` [byte], and keeps its programs."""
    if not is_kept():
        return
    psutil = require("psutil", "study", "a study")
    if psutil.Process().memory_info().rss > most:
        clear()


def clear_in_time() -> None:
    """`clear` if this process has used `SHARE` of the mappings it may have.

    A derivative of a motion takes a thousand, Linux allows 65,530 by default, and a process that
    asks for more ends in a segmentation fault.
    """
    if mappings() > SHARE * most_mappings():
        clear()


def mappings() -> int:
    """How many mappings this process has; 0 where the system does not tell."""
    return MAPPED.read_bytes().count(b"\n") if MAPPED.exists() else 0


def most_mappings() -> float:
    """How many a process may have; infinite where the system does not tell."""
    return float(MOST_MAPPED.read_text()) if MOST_MAPPED.exists() else float("inf")
