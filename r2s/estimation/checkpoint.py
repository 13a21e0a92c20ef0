"""What an estimator has so far, in a file from which a killed run goes on."""

import io
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from r2s.files import write_bytes

T = TypeVar("T")


def fingerprint(*parts: Any) -> str:
    """A hash of all numbers of some pytrees, of their structure, and of what else is in them."""
    digest = sha256()
    for part in parts:
        leaves, tree = jax.tree.flatten(part)
        digest.update(repr(tree).encode())
        for leaf in leaves:
            leaf = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
            digest.update(f"{leaf.shape} {leaf.dtype}".encode())
            digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def save(path: Path, problem: str, rows: list[Any]) -> None:
    """Writes pytrees of one structure, with the fingerprint of what they are of."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stacked = jax.tree.leaves(jax.tree.map(lambda *leaves: np.stack(leaves), *rows))
    buffer = io.BytesIO()
    np.savez(buffer, problem=np.array(problem), **{f"{i}": a for i, a in enumerate(stacked)})
    write_bytes(path, buffer.getvalue())


def load(path: Path, problem: str, like: T) -> list[T]:
    """The pytrees that `save` wrote, of the structure of `like`; none when there is no file.

    Raises `ValueError` when the file is of another problem, or no checkpoint.
    """
    if not path.exists():
        return []
    try:
        with np.load(path) as stored:
            found = str(stored["problem"])
            leaves = [jnp.asarray(stored[f"{i}"]) for i in range(len(stored.files) - 1)]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{path} is no checkpoint of an estimate: {error}; remove it") from error
    if found != problem:
        raise ValueError(
            f"{path} is of another recording, space or setting: remove it, or choose another file"
        )
    tree = jax.tree.structure(like)
    return [jax.tree.unflatten(tree, [leaf[i] for leaf in leaves]) for i in range(len(leaves[0]))]
