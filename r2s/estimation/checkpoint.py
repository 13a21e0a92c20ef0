"""Checkpoints: arrays and a description of their run in one NPZ, from which a killed run resumes.

run = {"kind": "descent", "run": fingerprint(problem, key)}
save(path, {"theta": theta}, run)
arrays = load(path, run)  # None: there is no such file
"""

import io
import json
from collections.abc import Mapping
from glob import escape
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from r2s._util.checks import SHOWN, shown
from r2s._util.files import write_bytes

FORMAT = "r2s-checkpoint/1"
HEADER = "checkpoint"  # the array that holds the JSON text
FEW = 5  # differences that an error names
T = TypeVar("T")


def save(path: Path | str, arrays: Mapping[str, Any], run: Mapping[str, Any]) -> None:
    """Write arrays and the JSON description of their `run` (settings to read back, a `fingerprint`
    of the rest), whole or not at all. Raises `ValueError` for an array named `HEADER`."""
    if HEADER in arrays:
        raise ValueError(f"no array of a checkpoint can be named {HEADER!r}")
    header = json.dumps({"format": FORMAT, "run": dict(run)})
    stored: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    buffer = io.BytesIO()
    np.savez(buffer, **stored, **{HEADER: np.array(header)})  # pyright: ignore[reportArgumentType]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, buffer.getvalue())


def read(path: Path | str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays that `save` wrote, and the description of their run.

    Raises `FileNotFoundError`, or `ValueError` that names the file if it is no checkpoint.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(HEADER)))
        form, run = header["format"], dict(header["run"])
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file raises anything
        raise ValueError(f"{path} is no checkpoint: {str(error)[:SHOWN]}; remove it") from error
    if form != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {shown(form)}")
    return arrays, run


def load(path: Path | str, run: Mapping[str, Any]) -> dict[str, np.ndarray] | None:
    """The arrays that `save` wrote for the same `run`; None when there is no file.

    Raises `ValueError` that names the file when it is no checkpoint, or of another run.
    """
    if not Path(path).exists():
        return None
    arrays, stored = read(path)
    asked = json.loads(json.dumps(dict(run)))  # tuples become lists
    keys = [key for key in {**stored, **asked} if stored.get(key) != asked.get(key)]
    if keys:
        there = {key: str(stored.get(key))[:SHOWN] for key in keys[:FEW]}
        pairs = ", ".join(f"{key} {it} there, {asked.get(key)} asked" for key, it in there.items())
        raise ValueError(f"{path} is of another run ({pairs}): remove it, or choose another file")
    return arrays


def forget(path: Path) -> None:
    """Remove a state file, and those of later stages, which have a longer name."""
    for file in (path, *path.parent.glob(f"{escape(path.stem)}.*{path.suffix}")):
        file.unlink(missing_ok=True)


def fingerprint(*parts: Any) -> str:
    """A hash of all numbers of some pytrees, of their structure, and of what else is in them."""
    digest = sha256()
    for part in parts:
        leaves, tree = jax.tree.flatten(part)
        digest.update(repr(tree).encode())
        for leaf in leaves:
            if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf = jax.random.key_data(leaf)
            leaf = np.asarray(leaf)
            digest.update(f"{leaf.shape} {leaf.dtype}".encode())
            digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def arrays_of(tree: Any) -> dict[str, np.ndarray]:
    """The leaves of a pytree by their path, for `save`."""
    leaves, _ = jax.tree.flatten_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def tree_from(arrays: Mapping[str, np.ndarray], like: T) -> T:
    """The pytree whose `arrays_of` were saved, of the structure of `like`.

    Raises `ValueError` when an array is missing.
    """
    paths, tree = jax.tree.flatten_with_path(like)
    names = [jax.tree_util.keystr(path) for path, _ in paths]
    if missing := [name for name in names if name not in arrays]:
        raise ValueError(f"the checkpoint lacks {', '.join(missing)}")
    return jax.tree.unflatten(tree, [jnp.asarray(arrays[name]) for name in names])
