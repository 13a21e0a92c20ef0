"""Traced programs, kept in files between processes, beside the compiled ones of `r2s.programs`.

Compiled programs are found by their lowered text, and to make that takes as long as to compile:
30 s for the derivative of a lift. So a function that is `kept` is also found by what it is: by the
source of r2s, the versions of the libraries, and the structure, shapes and static parts of its
arguments. What was lowered is stored by `jax.export`, and is what runs in the first process too, so
that all get the same numbers.

The files are pickles, which run what they say when they are read, as compiled programs do when they
are called: `r2s.programs` reads only a folder that is the user's own. Constants and functions of
r2s that a program replaces while it runs are not in the key: such a program must not keep anything.
"""

import dataclasses
import functools
import hashlib
import io
import os
import pickle
import platform
import threading
import time
import weakref
from collections.abc import Callable
from importlib import metadata
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
from jax.core import Tracer

from r2s import programs
from r2s.files import source_files, source_hash
from r2s.side_by_side import settings

LIBRARIES = ("jax", "jaxlib", "equinox", "lineax", "numpy")
KNOWN = {"r2s", "builtins", "copyreg", "collections", "numpy", "pathlib", *LIBRARIES}
BEGAN = time.time() - time.process_time()  # [s], of this process, or a little later


class Kept:
    """A function of pytrees, compiled as by `equinox.filter_jit`, and kept.

    It is a `filter_jit` and no more where no folder keeps programs (`r2s.programs.keep`), where the
    function or the class of an argument is not of a source that is known, where the source of r2s
    changed since this process began, and on machines of several devices.
    """

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._function, self._jitted = function, eqx.filter_jit(function)
        self._ready: dict[Any, Callable] = {}
        self._compiled: set[Any] = set()
        self._locks: dict[Any, threading.RLock] = {}  # of each program
        _all.add(self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        dynamic, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, _ = jax.tree.flatten(dynamic)
        if not _plain(leaves):
            return self._jitted(*args, **kwargs)
        if programs.kept() is None:
            return self._compiled_once(_known(dynamic, static), args, kwargs)
        return self._program(dynamic, static)(leaves)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Trace and compile for these arguments, and run nothing; from any thread."""
        dynamic, static = eqx.partition((args, kwargs), eqx.is_array)
        if programs.kept() is not None and _plain(jax.tree.leaves(dynamic)):
            self._program(dynamic, static)

    def _program(self, dynamic: Any, static: Any) -> Callable:
        known = _known(dynamic, static)
        with self._lock_of(known):
            if known not in self._ready:
                self._ready[known] = self._make(dynamic, static, known)
            return self._ready[known]

    def _compiled_once(self, known: tuple, args: tuple, kwargs: dict) -> Any:
        """By `filter_jit`, which compiles twice what two threads call for the first time."""
        if known in self._compiled:
            return self._jitted(*args, **kwargs)
        with self._lock_of(known):
            found = self._jitted(*args, **kwargs)
            self._compiled.add(known)
            return found

    def _lock_of(self, known: tuple) -> threading.RLock:
        return self._locks.setdefault(known, threading.RLock())

    def _make(self, dynamic: Any, static: Any, known: tuple) -> Callable:
        store = programs.kept()
        leaves, tree = jax.tree.flatten(dynamic)
        specs = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in leaves]
        source = _source()
        if store is None or source is None:
            return self._alone(tree, static, known)
        try:
            like = jax.tree.unflatten(tree, range(len(leaves)))
            what = _pickled((self._function, like, static))
            key = _digest(self._function.__name__, source, what, known[1])
            content = store.get(key)
            if content is None:
                content = self._trace(tree, static, specs)
                store.put(key, content)
        except (pickle.PicklingError, NotImplementedError):  # the latter: calls back to Python
            return self._alone(tree, static, known)
        parts, out_like = pickle.loads(content)
        call = jax.jit(jax.export.Exported(**parts, _get_vjp=None).call)
        compiled, structure = call.lower(specs).compile(), jax.tree.structure(out_like)
        return lambda leaves: jax.tree.unflatten(structure, compiled(leaves))

    def _trace(self, tree: Any, static: Any, specs: list) -> bytes:
        found: list = []

        def noted(leaves: list) -> list:
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            out, structure = jax.tree.flatten(self._function(*args, **kwargs))
            found.append(jax.tree.unflatten(structure, range(len(out))))
            return out

        exported = jax.export.export(jax.jit(noted))(specs)
        return pickle.dumps((_parts(exported), found[-1]))

    def _alone(self, tree: Any, static: Any, known: tuple) -> Callable:
        def run(leaves: list) -> Any:
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            return self._compiled_once(known, args, kwargs)

        return run


_all: weakref.WeakSet[Kept] = weakref.WeakSet()


def let_go() -> None:
    """Let all programs go from memory, as `jax.clear_caches` does with its own."""
    for each in _all:
        each._ready.clear()
        each._compiled.clear()


def kept(function: Callable) -> Kept:
    """`Kept`, as a decorator."""
    return Kept(function)


def _plain(leaves: list) -> bool:
    """Whether a program for this machine's only device takes these arrays, and none is traced.

    Where JAX knows float32 alone, it would convert arrays of float64 that were made elsewhere.
    """
    if jax.device_count() > 1 or jax.config.jax_disable_jit:  # pyright: ignore
        return False
    return not any(isinstance(leaf, Tracer) for leaf in leaves) and all(
        leaf.devices() == set(jax.devices()) and _is_of_this_precision(leaf) for leaf in leaves
    )


def _is_of_this_precision(leaf: Any) -> bool:
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
    return is_key or leaf.dtype.itemsize < 8 or bool(jax.config.jax_enable_x64)  # pyright: ignore


def _known(dynamic: Any, static: Any) -> tuple:
    """What tells one program of a function from another."""
    leaves, tree = jax.tree.flatten(dynamic)
    parts, static_tree = jax.tree.flatten(static)
    typed = tuple((type(part), part) for part in parts)  # 2 is not 2.0, though they are equal
    return tree, tuple(_shape(leaf) for leaf in leaves), typed, static_tree, settings()


def _shape(leaf: Any) -> tuple:
    return leaf.shape, str(leaf.dtype), leaf.weak_type


def _parts(exported: jax.export.Exported) -> dict[str, Any]:
    """The fields of what was exported; its own way to write them needs one more library."""
    names = (each.name for each in dataclasses.fields(exported))
    return {name: getattr(exported, name) for name in names if name != "_get_vjp"}


class _Pickler(pickle.Pickler):
    """Refuses what it has no source of: then a change would not be seen."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | FunctionType):
            if str(obj.__module__).partition(".")[0] not in KNOWN:
                raise pickle.PicklingError(f"{obj.__module__} is not known")
        return NotImplemented


def _pickled(part: Any) -> bytes:
    stream = io.BytesIO()
    try:
        _Pickler(stream, protocol=5).dump(part)
    except (AttributeError, TypeError) as error:  # a local function, a device
        raise pickle.PicklingError(str(error)) from error
    return stream.getvalue()


def _digest(name: str, source: str, what: bytes, shapes: tuple) -> str:
    told = repr((source, settings(), jax.default_backend(), shapes))
    told += os.environ.get("EQX_ON_ERROR", "")
    return f"traced_{name}-{hashlib.sha256(told.encode() + what).hexdigest()}"


def _source() -> str | None:
    """A hash of the source of r2s and of the versions of what it is traced by.

    None when a file changed since this process began, which may have loaded it before.
    """
    digest = hashlib.sha256(platform.python_version().encode())
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}".encode())
    stats = [file.stat() for file in source_files()]
    if any(max(found.st_mtime, found.st_ctime) > BEGAN for found in stats):
        return None
    digest.update(source_hash().encode())
    return digest.hexdigest()
