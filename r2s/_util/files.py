"""Files that are written whole or not at all, and JSON that is read strictly."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import os
import re
import shutil
import sys
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from r2s._util.checks import SHOWN, expect_value

T = TypeVar("T")
LONGEST = 1000  # characters of an error
# or a string, which may look like one
COMMENT = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/', re.DOTALL)


@functools.cache
def source_hash() -> str:
    """A hash of the source files of r2s, hexadecimal, as they were at the first call."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(str(file.relative_to(root)).encode() + file.read_bytes())
    return digest.hexdigest()


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write `data` to `path`: a reader finds the old file or the new one, never a part.

    Raises OSError (of the kind that the system gave) that names `path`, the size of the data and
    the free space; no temporary file is left behind.
    """
    path = Path(path)
    # In the same folder, since os.replace cannot cross file systems.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error)
        message = f"cannot write {path} ({len(data)} bytes; {_free(path.parent)}): {reason}"
        raise OSError(error.errno, message) from error
    finally:
        with contextlib.suppress(OSError):  # it is gone already when all went well
            temporary.unlink()


def check_folders(*paths: Path | None) -> None:
    """Raise `FileNotFoundError` where the folder of a file that will be written is missing, and
    `IsADirectoryError` where the file is a folder: before the work of making what is in it."""
    for path in paths:
        if path is not None and path.is_dir():
            raise IsADirectoryError(f"{path}: this is a folder; name a file to write")
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"{path}: there is no folder {path.parent} to write it to")


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all; raises as `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` as JSON to `path`, whole or not at all.

    Raises ValueError for NaN and infinities (which JSON lacks), TypeError for what JSON cannot
    hold, and OSError as `write_bytes`.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_npz(path: Path | str, **arrays: Any) -> None:
    """Write named arrays as one NPZ, whole or not at all; raises as `write_bytes`."""
    buffer = io.BytesIO()
    made: dict[str, Any] = {name: np.asarray(values) for name, values in arrays.items()}
    np.savez(buffer, **made)
    write_bytes(path, buffer.getvalue())


def read_npz(path: Path | str, *needed: str, text: str = "") -> dict[str, np.ndarray]:
    """The arrays of an NPZ, by name: numbers, but for one of the name `text`.

    Raises FileNotFoundError, or a ValueError (which does not name the file) when it is damaged, one
    of the arrays `needed` is missing, or one that holds something else.
    """
    try:
        stored = np.load(path, allow_pickle=False)
        if isinstance(stored, np.ndarray):
            raise TypeError("it is one array (NPY), no archive of several (NPZ)")
        with stored as file:
            arrays = dict(file)
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged archive raises anything, from EOFError to zlib.error
        # NumPy takes what is no archive for a pickle
        words = "no NPZ" if "allow_pickle" in str(error) else str(error)[:SHOWN]
        raise ValueError(f"{words}: copy the file again, or make it anew") from error
    if lacking := [name for name in needed if name not in arrays]:
        raise ValueError(f"lacks the arrays {', '.join(lacking)}; has {', '.join(arrays)}")
    for name, array in arrays.items():
        found = np.asarray(array).dtype  # of bytes where the archive holds another kind of file
        if found.kind not in ("U" if name == text else "fiub"):
            expected = "text" if name == text else "numbers"
            raise ValueError(f"{name}: expected {expected}, found {found}")
    return arrays


def read_json(path: Path | str, kind: type[T], comments: bool = False) -> T:
    """Read the dataclass `kind` from JSON: its fields, no more and (but for defaults) no less.

    Fields are numbers (finite), strings, booleans, tuples (JSON lists), mappings and dataclasses,
    or one of these or null. With `comments`, those of C++ are skipped.
    A class attribute `former` of `kind` has the present names of fields that files call otherwise.
    The metadata "unknown" of a field is the hint in the error when it is missing or null. Raises
    OSError, or a ValueError that names the file and the field: no JSON, fields missing or unknown,
    values of another type, or what `kind` itself refuses.
    """
    return parse(kind, load_json(path, comments), f"{path}")


def load_json(
    path: Path | str, comments: bool = False, each: Callable[[dict], Any] | None = None
) -> Any:
    """What JSON a file holds; `each` object in it may be replaced. With `comments`, those of C++
    are skipped. Raises OSError, or a ValueError that names the file."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if comments:
            text = COMMENT.sub(lambda m: m[1] or re.sub(r"[^\n]", " ", m[0]), text)
        return json.loads(text, object_hook=each)
    except (ValueError, RecursionError) as error:  # no text, no JSON, or nested too deeply
        raise ValueError(f"{path}: no JSON: {error}") from error


def _free(folder: Path) -> str:
    try:
        return f"{shutil.disk_usage(folder).free} bytes free in {folder}"
    except OSError:
        return f"folder {folder} is missing or cannot be read"


def parse(kind: Any, value: Any, where: str) -> Any:
    """What JSON gave as a dataclass, tuple, mapping or plain type, or one or None.

    As `read_json`; errors begin with `where`.
    """
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        (kind,) = (each for each in typing.get_args(kind) if each is not types.NoneType)
    if dataclasses.is_dataclass(kind):
        return _read_fields(kind, value, where)
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        expect_value(isinstance(value, list), where, "a list", value)
        if arguments[1:] == (...,):
            arguments = (arguments[0],) * len(value)
        expect_value(len(value) == len(arguments), where, f"{len(arguments)} entries", value)
        entries = enumerate(zip(arguments, value, strict=True))
        return tuple(parse(kind, entry, f"{where}[{i}]") for i, (kind, entry) in entries)
    if typing.get_origin(kind) is Mapping:
        expect_value(isinstance(value, dict), where, "an object", value)
        return {key: parse(arguments[1], v, f"{where}: {key}") for key, v in value.items()}
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        holds = number and abs(value) <= sys.float_info.max
        expect_value(holds, where, "a finite number", value)
        return float(value)
    expect_value(type(value) is kind, where, f"{kind.__name__}", value)
    return value


def _read_fields(kind: Any, value: Any, where: str) -> Any:
    expect_value(isinstance(value, dict), where, "an object", value)
    value = {getattr(kind, "former", {}).get(name, name): each for name, each in value.items()}
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name, field in fields.items():
        if "unknown" in field.metadata and value.get(name) is None:
            raise ValueError(f"{where}: {name} is unknown: {field.metadata['unknown']}")
    needed = {name for name, field in fields.items() if field.default is dataclasses.MISSING}
    missing, unknown = sorted(needed - value.keys()), sorted(value.keys() - fields.keys())
    if missing or unknown:
        lists = {"missing": missing, "unknown": unknown, "known": list(fields) if unknown else []}
        said = (f"{name}: {', '.join(names)}" for name, names in lists.items() if names)
        raise ValueError(f"{where}: {'; '.join(said)}")
    read = {name: parse(fields[name].type, v, f"{where}: {name}") for name, v in value.items()}
    try:
        return kind(**read)
    except (ValueError, OverflowError) as error:  # also of whole numbers beyond 64 bits
        raise ValueError(f"{where}: {str(error)[:LONGEST]}") from error
