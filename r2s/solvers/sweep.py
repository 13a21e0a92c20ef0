"""A function of one fabric (or trajectory, or seed) for thousands, on all devices of all hosts.

    for first, results in stream(lowest, fabrics, chunk=256, folder=Path("sweep")):
        ...

`lowest` is a pure function of one member; `fabrics` has a leading axis on every array. A chunk is
spread over the devices, and on each of them run by `vmap`. On several hosts every process makes the
same call after `jax.distributed.initialize`, and has all results.
"""

import io
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from r2s._util.files import write_bytes
from r2s._util.threads import check, planned

AXIS = "member"


def sweep(
    function: Callable[[Any], Any],
    members: Any,
    chunk: int = 256,
    *,
    folder: Path | None = None,
    devices: Mesh | None = None,
) -> Any:
    """The results of all members, in NumPy arrays with a leading axis; for arguments see `stream`.

    >>> members = {"a": np.ones(3), "b": np.arange(3.0)}
    >>> sweep(lambda member: member["a"] + member["b"], members, chunk=2).tolist()
    [1.0, 2.0, 3.0]
    """
    chunks = stream(function, members, chunk, folder=folder, devices=devices)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part for _, part in chunks))


def stream(
    function: Callable[[Any], Any],
    members: Any,
    chunk: int = 256,
    *,
    folder: Path | None = None,
    devices: Mesh | None = None,
) -> Iterator[tuple[int, Any]]:
    """The number of the first member of each chunk, and the results of the chunk, as they come.

    - `members`: a pytree of arrays with a leading axis, all of the same length.
    - `chunk`: members at once, rounded up to a multiple of the devices.
    - `folder`: where each chunk's result is kept. One of the same members is read, so that an
      interrupted sweep is resumed. Take another folder for another function.
    - `devices`: a mesh with the axis "member"; by default all devices of all processes.

    A member that diverges stops nothing. Raises `ValueError` for arrays of different lengths, or
    none, and before it runs `MemoryError` for a chunk that does not fit the memory of a device.
    """
    devices = all_devices() if devices is None else devices
    count = _length(members)
    size = -(-min(chunk, count) // devices.size) * devices.size
    batch, spec = jax.vmap(function), PartitionSpec(AXIS)
    # without the check, which would refuse loops that begin with constants
    run = jax.shard_map(batch, mesh=devices, in_specs=spec, out_specs=spec, check_vma=False)
    compiled = like = None
    for first in range(0, count, size):
        part = _part(members, slice(first, first + size))
        kept = min(size, count - first)
        path = None if folder is None else folder / f"{first:08d}-{_digest(part)}.eqx"
        if path is not None and path.exists():
            like = jax.eval_shape(batch, part) if like is None else like
            yield first, _read(path, like, kept)
            continue
        shards = _shard(part, size, devices)
        if compiled is None:
            compiled = jax.jit(run).lower(shards).compile()
            check(planned(compiled), f"a chunk of {size} members", f"take a chunk below {size}")
        results = compiled(shards)
        if jax.process_count() > 1:
            results = multihost_utils.process_allgather(results, tiled=True)
        results = _part(jax.device_get(results), slice(kept))
        if path is not None and jax.process_index() == 0:
            buffer = io.BytesIO()
            eqx.tree_serialise_leaves(buffer, results)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, buffer.getvalue())
        yield first, results


def all_devices() -> Mesh:
    """A mesh of all devices of all processes, along the members."""
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(AxisType.Auto,))


def _length(members: Any) -> int:
    lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(members)}
    if len(lengths) != 1 or lengths == {()} or lengths == {(0,)}:
        raise ValueError(f"members need one leading axis on all arrays, found {sorted(lengths)}")
    return lengths.pop()[0]


def _part(members: Any, chosen: slice) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf[chosen]), members)


def _shard(part: Any, size: int, devices: Mesh) -> Any:
    """Members, of which the last is repeated, on the devices; a process sees its own alone."""
    sharding = NamedSharding(devices, PartitionSpec(AXIS))

    def of_leaf(leaf: np.ndarray) -> jax.Array:
        whole = np.concatenate([leaf, np.repeat(leaf[-1:], size - len(leaf), axis=0)])
        return jax.make_array_from_callback(whole.shape, sharding, lambda at: whole[at])

    return jax.tree.map(of_leaf, part)


def _digest(part: Any) -> str:
    digest = sha256()
    for leaf in jax.tree.leaves(part):
        digest.update(f"{leaf.dtype}{leaf.shape}".encode() + np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _read(path: Path, like: Any, kept: int) -> Any:
    empty = jax.tree.map(lambda leaf: np.empty((kept, *leaf.shape[1:]), leaf.dtype), like)
    return eqx.tree_deserialise_leaves(path, empty)
