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

from r2s.environment.air import Fan
from r2s.mesh.vectors import Vector, scale, subtract


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

    def constant(self, values: np.ndarray, first: int, like: Array) -> Array:
        """Numbers of the vertices as an array that begins at a place, zero outside."""
        row = np.pad(np.asarray(values, float).ravel(), self.room)[first + self.room :]
        row = row[: self.length(first)]
        return jnp.asarray(row[:, None] if self.batched else row, like.dtype)

    def length(self, first: int) -> int:
        """Of arrays that begin at a place: cells end with the vertices, bends as far after them as
        they begin before.
        """
        return self.count - first if first == self.first_cell else self.count - 2 * first

    def padded(self, array: Array, first: int, last: int) -> Array:
        """With zeros before the first and after the last place."""
        widths = [(first, last)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, widths)

    def wide(self, x: Array) -> Vector:
        """Components of vectors of the vertices (vertex, 3, ...), with room on either side."""
        one, two, three = (self.padded(x[:, i], self.room, self.room) for i in range(3))
        return one, two, three

    @property
    def vertex_areas(self) -> np.ndarray:
        """Rest areas of the vertices, [m^2]."""
        along = [np.ones(count) for count in self.shape]
        for each in along:
            each[[0, -1]] = 0.5
        return np.prod(self.spacing) * np.outer(*along)

    def row(self, number: Array) -> Array:
        """A number of each member, for arrays (place, member)."""
        return number[None] if self.batched else number

    def to_cells(self, samples: Array) -> Vector:
        """Vectors (cell, sample, 3, ...) of the cells alone: a row of all places of each sample."""
        rows, columns = self.shape
        cells = samples.reshape(rows - 1, columns - 1, *samples.shape[1:])
        widths = [(0, 1), (0, 1)] + [(0, 0)] * (cells.ndim - 2)
        flat = jnp.pad(cells, widths).reshape(self.count, *samples.shape[1:])
        wide = jnp.moveaxis(self.padded(flat, -self.first_cell, 0), 1, 0)
        row = wide.reshape(-1, *samples.shape[2:])
        return row[:, 0], row[:, 1], row[:, 2]

    def from_cells(self, row: Vector) -> Array:
        """The reverse of `to_cells`."""
        rows, columns = self.shape
        both = jnp.stack(row, axis=1)
        wide = both.reshape(-1, self.length(self.first_cell), *both.shape[1:])
        cells = jnp.moveaxis(wide[:, -self.first_cell :], 0, 1)
        square = cells.reshape(*self.shape, *cells.shape[1:])[:-1, :-1]
        return square.reshape((rows - 1) * (columns - 1), *cells.shape[1:])

    def flow(self, x: Vector, v: Vector, wind: Array, fan: Fan | None) -> Vector:
        """Velocities [m/s] less the wind's: one for all vertices (3, ...), or (vertex, 3, ...)."""
        if wind.ndim == (2 if self.batched else 1):
            blowing = self.rows(wind)
        else:
            blowing = self.wide(wind)
        if fan is not None:
            blows = jax.vmap(Fan.__call__, -1, -1) if self.batched else Fan.__call__
            strength = blows(fan, jnp.stack(x, axis=1))
            blowing = scale(strength, blowing)
        return subtract(v, blowing)

    def rows(self, vector: Array) -> Vector:
        """A vector for all vertices, (3, ...)."""
        return self.row(vector[0]), self.row(vector[1]), self.row(vector[2])

    def index(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of every vertex."""
        rows, columns = np.indices(self.shape)
        return rows, columns


def part(array: Array, begin: int, length: int) -> Array:
    """Some places of a row."""
    return array[begin : begin + length]


def is_cell(layout: Layout, like: Array) -> Array:
    """Which places are the origin of a cell."""
    rows, columns = layout.index()
    inside = (rows < layout.shape[0] - 1) & (columns < layout.shape[1] - 1)
    return layout.constant(inside, layout.first_cell, like) > 0


def batch_last(function: Callable[[bool, Any], Any], inputs: Any) -> Any:
    """`function(False, inputs)`, which under `jax.vmap` is `function(True, inputs)`.

    The latter has a batch as last axis of every array, and of every result. `jax.vmap` of
    `jax.vmap` makes one batch of both. Derivatives are those of `function(False, inputs)`, and
    with them a batch is JAX's own.
    """
    arrays, static = eqx.partition(inputs, eqx.is_array)

    def of_arrays(batched, arrays):
        return function(batched, eqx.combine(arrays, static))

    @jax.custom_batching.custom_vmap
    def of_members(arrays):
        return of_arrays(True, arrays)

    @of_members.def_vmap
    def _(size, in_batched, arrays):
        count = jax.tree.leaves(arrays)[0].shape[-1]

        def merged(leaf, is_batched):
            leaf = (
                jnp.moveaxis(leaf, 0, -1) if is_batched else jnp.repeat(leaf[..., None], size, -1)
            )
            return leaf.reshape(*leaf.shape[:-2], count * size)

        merged = of_members(jax.tree.map(merged, arrays, in_batched[0]))
        found = jax.tree.map(
            lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], count, size), -1, 0), merged
        )
        return found, jax.tree.map(lambda _: True, found)

    @jax.custom_batching.custom_vmap
    def of_one(arrays):
        return of_arrays(False, arrays)

    @of_one.def_vmap
    def _(size, in_batched, arrays):
        def last(leaf, is_batched):
            if is_batched:
                return jnp.moveaxis(leaf, 0, -1)
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, size))

        found = of_members(jax.tree.map(last, arrays, in_batched[0]))
        found = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), found)
        return found, jax.tree.map(lambda _: True, found)

    @jax.custom_jvp
    def called(arrays):
        return of_one(arrays)

    @called.defjvp
    def _(primals, tangents):
        return jax.jvp(partial(of_arrays, False), primals, tangents)

    return called(arrays)
