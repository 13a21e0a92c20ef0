"""How the arrays of a grid lie: its vertices in one row, with room on either side.

Vertex (i, j) has the place i * columns + j. Neighbours are slices of the row, a shift apart: the
places that are no cell (or no inner vertex) are computed along, and count for nothing. Beside the
vertices there is room for two lines, so that no slice ends outside. A batch is the last axis.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s.mesh.plate_elements import grid_areas
from r2s.mesh.vectors import Vector, columns


class Layout(NamedTuple):
    """A grid, static.

    - `shape`: vertices along warp and weft. `spacing`: between them, [m].
    - `batched`: whether arrays have a last axis of members.
    """

    shape: tuple[int, int]
    spacing: tuple[float, float]
    batched: bool = False

    @property
    def count(self) -> int:
        """Number of vertices."""
        return self.shape[0] * self.shape[1]

    @property
    def room(self) -> int:
        """Places before the first vertex, and after the last one."""
        return 2 * self.shape[1]

    @property
    def first_cell(self) -> int:
        """The first place from which a cell could reach vertex 0."""
        return -self.shape[1] - 1

    def length(self, first: int) -> int:
        """Of arrays that begin at a place: cells end with the vertices, bends as far after them as
        they begin before.
        """
        return self.count - first if first == self.first_cell else self.count - 2 * first

    def constant(self, values: np.ndarray, first: int, like: Array) -> Array:
        """Numbers of the vertices as an array that begins at a place, zero outside."""
        row = np.pad(np.asarray(values, float).ravel(), self.room)[first + self.room :]
        row = row[: self.length(first)]
        return jnp.asarray(row[:, None] if self.batched else row, like.dtype)

    def is_cell(self, like: Array) -> Array:
        """Which places are the origin of a cell."""
        rows, columns = np.indices(self.shape)
        inside = (rows < self.shape[0] - 1) & (columns < self.shape[1] - 1)
        return self.constant(inside, self.first_cell, like) > 0

    def areas(self, like: Array) -> Array:
        """Rest areas of the vertices, [m^2]."""
        return self.constant(grid_areas(self.spacing, self.shape), 0, like)

    def row(self, number: Array) -> Array:
        """A number of each member, for arrays (place, member)."""
        return number[None] if self.batched else number

    def padded(self, array: Array, first: int, last: int) -> Array:
        """With zeros before the first and after the last place."""
        widths = [(first, last)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, widths)

    def wide(self, x: Array) -> Vector:
        """Components of vectors of the vertices (vertex, 3, ...), with room on either side."""
        return columns(self.padded(x, self.room, self.room))

    def inner(self, x: Vector) -> Vector:
        """What has room on either side without it."""
        return parts(x, self.room, self.count)

    def put(self, wide: Vector, x: Vector) -> Vector:
        """The vertices' components in an array with room."""
        at = slice(self.room, self.room + self.count)
        return wide[0].at[at].set(x[0]), wide[1].at[at].set(x[1]), wide[2].at[at].set(x[2])

    def to_cells(self, samples: Array) -> Vector:
        """Vectors (cell, sample, 3, ...) of the cells alone: a row of all places of each sample."""
        cells = samples.reshape(self.shape[0] - 1, self.shape[1] - 1, *samples.shape[1:])
        widths = [(0, 1), (0, 1)] + [(0, 0)] * (cells.ndim - 2)
        flat = jnp.pad(cells, widths).reshape(self.count, *samples.shape[1:])
        wide = jnp.moveaxis(self.padded(flat, -self.first_cell, 0), 1, 0)
        return columns(wide.reshape(-1, *samples.shape[2:]))

    def from_cells(self, row: Vector) -> Array:
        """The reverse of `to_cells`."""
        rows, columns = self.shape
        both = jnp.stack(row, axis=1)
        wide = both.reshape(-1, self.length(self.first_cell), *both.shape[1:])
        cells = jnp.moveaxis(wide[:, -self.first_cell :], 0, 1)
        square = cells.reshape(*self.shape, *cells.shape[1:])[:-1, :-1]
        return square.reshape((rows - 1) * (columns - 1), *cells.shape[1:])


def part(array: Array, begin: int, length: int) -> Array:
    """Some places of a row."""
    return array[begin : begin + length]


def parts(x: Vector, begin: int, length: int) -> Vector:
    """Some places of a vector's components."""
    return part(x[0], begin, length), part(x[1], begin, length), part(x[2], begin, length)


def batch_last(function: Callable[[bool, Any], Any], inputs: Any) -> Any:
    """`function(False, inputs)`, which under `jax.vmap` is `function(True, inputs)`.

    The latter has a batch as last axis of every array, and of every result. `jax.vmap` of
    `jax.vmap` makes one batch of both. Derivatives are those of `function(False, inputs)`, and
    with them a batch is JAX's own.
    """
    arrays, static = eqx.partition(inputs, eqx.is_array)

    def plain(batched: bool, arrays: Any) -> Any:
        return function(batched, eqx.combine(arrays, static))

    def batching(batched: bool) -> Callable:
        run = jax.custom_batching.custom_vmap(partial(plain, batched))

        @run.def_vmap
        def _(size, in_batched, arrays):
            def last(leaf, is_batched):
                moved = jnp.broadcast_to(leaf[..., None], (*leaf.shape, size))
                if is_batched:
                    moved = jnp.moveaxis(leaf, 0, -1)
                return moved.reshape(*moved.shape[:-2], -1) if batched else moved

            def first(leaf):
                leaf = leaf.reshape(*leaf.shape[:-1], -1, size) if batched else leaf
                return jnp.moveaxis(leaf, -1, 0)

            results = batching(True)(jax.tree.map(last, arrays, in_batched[0]))
            results = jax.tree.map(first, results)
            return results, jax.tree.map(lambda _: True, results)

        return run

    @jax.custom_jvp
    def called(arrays):
        return batching(False)(arrays)

    @called.defjvp
    def _(primals, tangents):
        return jax.jvp(partial(plain, False), primals, tangents)

    return called(arrays)
