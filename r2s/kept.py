"""Traced programs, kept in files between processes, beside the compiled ones of `r2s.programs`.

Compiled programs are found by their lowered text, and to make that takes as long as to compile:
30 s for the derivative of a lift. So a function that is `kept` is also found by what it is: by the
source of r2s, the versions of the libraries, and the structure, shapes and static parts of its
arguments. What was lowered is stored by `jax.export`, and is what runs in the first process too, so
that all get the same numbers.
"""

import dataclasses
import functools
import hashlib
import io
import os
import pickle
import platform
import threading
import weakref
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
from jax.core import Tracer

from r2s import programs

LIBRARIES = ("jax", "jaxlib", "equinox", "lineax", "numpy")
KNOWN = {"r2s", "builtins", "copyreg", "collections", "numpy", "pathlib", *LIBRARIES}
SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_debug_nans",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_platforms",
)


class Kept:
    """A function of pytrees, compiled as by `equinox.filter_jit`, and kept.

    Where no folder keeps programs (`r2s.programs.keep`), or an argument is of a class whose source
    is not that of r2s, it is a `filter_jit` and no more.
    """

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._function, self._jitted = function, eqx.filter_jit(function)
        self._ready: dict[Any, Callable] = {}
        self._lock = threading.Lock()
        _all.add(self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        dynamic, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, _ = jax.tree.flatten(dynamic)
        if programs.kept() is None or any(isinstance(leaf, Tracer) for leaf in leaves):
            return self._jitted(*args, **kwargs)
        return self._program(dynamic, static)(leaves)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Trace and compile for these arguments, and run nothing; from any thread."""
        if programs.kept() is not None:
            self._program(*eqx.partition((args, kwargs), eqx.is_array))

    def _program(self, dynamic: Any, static: Any) -> Callable:
        leaves, tree = jax.tree.flatten(dynamic)
        shapes = tuple(_shape(leaf) for leaf in leaves)
        known = (tree, shapes, *jax.tree.flatten(static))
        settings = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        known = (*known[:2], tuple(known[2]), known[3], settings)
        with self._lock:
            if known not in self._ready:
                self._ready[known] = self._make(dynamic, static, shapes)
            return self._ready[known]

    def _make(self, dynamic: Any, static: Any, shapes: tuple) -> Callable:
        store = programs.kept()
        leaves, tree = jax.tree.flatten(dynamic)

        try:
            like = jax.tree.unflatten(tree, range(len(leaves)))
            key = _digest(self._function, _pickled((like, static)), shapes)
        except pickle.PicklingError:
            return self._alone(tree, static)
        specs = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
        content = None if store is None else store.get(key)
        if content is None:
            found: list = []

            def noted(leaves: list) -> list:
                args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
                out, structure = jax.tree.flatten(self._function(*args, **kwargs))
                found.append(jax.tree.unflatten(structure, range(len(out))))
                return out

            exported = jax.export.export(jax.jit(noted))(specs)
            content = pickle.dumps((_parts(exported), found[-1]))
            if store is not None:
                store.put(key, content)
        parts, out_like = pickle.loads(content)
        call = jax.jit(jax.export.Exported(**parts, _get_vjp=None).call)
        compiled, structure = call.lower(specs).compile(), jax.tree.structure(out_like)
        return lambda leaves: jax.tree.unflatten(structure, compiled(_arrays(leaves)))

    def _alone(self, tree: Any, static: Any) -> Callable:
        def run(leaves: list) -> Any:
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            return self._jitted(*args, **kwargs)

        return run


_all: weakref.WeakSet[Kept] = weakref.WeakSet()


def let_go() -> None:
    """Let all programs go from memory, as `jax.clear_caches` does with its own."""
    for each in _all:
        each._ready.clear()


def kept(function: Callable) -> Kept:
    """`Kept`, as a decorator."""
    return Kept(function)


def _shape(leaf: Any) -> tuple:
    return leaf.shape, str(leaf.dtype)


def _parts(exported: jax.export.Exported) -> dict[str, Any]:
    """The fields of what was exported; its own way to write them needs one more library."""
    names = (each.name for each in dataclasses.fields(exported))
    return {name: getattr(exported, name) for name in names if name != "_get_vjp"}


def _arrays(leaves: list) -> list:
    return [jnp.asarray(leaf) for leaf in leaves]


class _Pickler(pickle.Pickler):
    """Refuses what it has no source of: then a change would not be seen."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | FunctionType):
            if obj.__module__.partition(".")[0] not in KNOWN:
                raise pickle.PicklingError(f"{obj.__module__} is not known")
        return NotImplemented


def _pickled(part: Any) -> bytes:
    stream = io.BytesIO()
    try:
        _Pickler(stream, protocol=5).dump(part)
    except (AttributeError, TypeError) as error:  # a local function, a device
        raise pickle.PicklingError(str(error)) from error
    return stream.getvalue()


def _digest(function: Callable, structure: bytes, shapes: tuple) -> str:
    name = f"{function.__module__}.{function.__qualname__}"
    settings = [getattr(jax.config, each) for each in SETTINGS]
    told = repr((name, _source(), settings, jax.default_backend(), jax.device_count(), shapes))
    told += os.environ.get("EQX_ON_ERROR", "")
    digest = hashlib.sha256(told.encode() + structure).hexdigest()
    return f"traced_{function.__name__}-{digest}"


@functools.cache
def _source() -> str:
    """A hash of the source of r2s and of the versions of what it is traced by."""
    digest = hashlib.sha256(platform.python_version().encode())
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}".encode())
    root = Path(__file__).parent
    for file in sorted(root.rglob("*.py")):
        digest.update(str(file.relative_to(root)).encode() + file.read_bytes())
    return digest.hexdigest()
