"""The factor of a sparse symmetric matrix in a band: of vertices in lines across a narrow mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

GROUP = 6  # of the width: how much of it a group has
Vectors = Float[Array, "vertex 3"]


class BandFactor(eqx.Module):
    """The factor of all groups.

    - `inverse`: of the block of the pivots, or of its lower triangular root if `is_definite`.
    - `coupling`: that inverse times the block of pivots and what follows.
    """

    inverse: Float[Array, "group pivot pivot"]
    coupling: Float[Array, "group pivot outer"]
    is_definite: bool = eqx.field(static=True)


class Band(eqx.Module):
    """An order of vertices, in groups of `size` that are coupled to `width` vertices after them.

    - `order`: the vertices; padding is their number.
    - `kept`: blocks of the matrix on and above the diagonal, but for those between earlier groups.
    - `group`, `row`, `column`: where each is: its group, and places from this group's first vertex.
    - `count`: of vertices.
    """

    order: Int[Array, "group row"]
    kept: Int[Array, " kept"]
    group: Int[Array, " kept"]
    row: Int[Array, " kept"]
    column: Int[Array, " kept"]
    count: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @classmethod
    def make(
        cls,
        places: Float[np.ndarray, "vertex axis"],
        rows: Int[np.ndarray, " block"],
        columns: Int[np.ndarray, " block"],
    ) -> "Band":
        """Of the vertices at `places`, by lines across or by neighbours, whichever is narrower.

        `rows` and `columns` are those of all blocks of the matrix.
        """
        orders = _by_lines(places), _by_neighbours(len(places), rows, columns)
        widths = [_width(order, rows, columns) for order in orders]
        width = min(widths)
        order = orders[widths.index(width)]
        size = min(max(1, round(width / GROUP)), width)
        at, groups = np.argsort(order), -(-len(order) // size)
        padded = np.full(groups * size, len(order))
        padded[: len(order)] = order
        group = at[rows] // size
        kept = np.flatnonzero(at[columns] >= group * size)  # the others are in earlier groups' rows
        row, column = (at[vertices] - group * size for vertices in (rows, columns))
        padded = padded.reshape(groups, size)
        padded, kept, group, row, column = (
            jnp.asarray(array, int)
            for array in (padded, kept, group[kept], row[kept], column[kept])
        )
        return cls(padded, kept, group, row, column, len(order), size, width)

    def factor(self, blocks: Float[Array, "block 3 3"], is_definite: bool = True) -> BandFactor:
        """The factor of a matrix: by Cholesky, which is NaN when it is not positive definite.

        Without `is_definite` by elimination with pivoting inside the groups.
        """
        inner, outer = 3 * self.size, 3 * self.width
        unit = jnp.eye(inner, dtype=blocks.dtype)

        def eliminate(left_over, rows):
            """`left_over`: of the later vertices, by those that are eliminated."""
            rows = rows.at[:, :outer].add(left_over[:inner])
            pivots, others = rows[:, :inner], rows[:, inner:]
            if is_definite:
                lower = jnp.linalg.cholesky(pivots, symmetrize_input=False)
                both = jnp.concatenate([unit, others], axis=1)
                both = jax.lax.linalg.triangular_solve(lower, both, left_side=True, lower=True)
                inverse, coupling = both[:, :inner], both[:, inner:]
                gone = coupling.T @ coupling
            else:
                inverse = jnp.linalg.inv(pivots)
                coupling = inverse @ others
                gone = others.T @ coupling
            rest = jnp.pad(left_over[inner:, inner:], ((0, inner), (0, inner)))
            return rest - gone, (inverse, coupling)

        none = jnp.zeros((outer, outer), blocks.dtype)
        _, (inverse, coupling) = jax.lax.scan(eliminate, none, self._rows(blocks))
        return BandFactor(inverse, coupling, is_definite)

    def _rows(self, blocks: Float[Array, "block 3 3"]) -> Float[Array, "group pivot front"]:
        """The rows of each group from its first vertex on; those of padding are of the identity."""
        groups, front = len(self.order), self.size + self.width
        rows = jnp.zeros((groups, self.size, 3, front, 3), blocks.dtype)
        where = rows.at[self.group, self.row, :, self.column]
        rows = where.set(blocks[self.kept], unique_indices=True)
        rows = rows.reshape(groups, 3 * self.size, 3 * front)
        padding = jnp.repeat((self.order == self.count).astype(blocks.dtype), 3, axis=1)
        return rows + padding[:, :, None] * jnp.eye(*rows.shape[1:], dtype=blocks.dtype)[None]

    def solve(self, factor: BandFactor, right: Vectors) -> Vectors:
        """The solution of the factored matrix times x = `right`."""
        inner, outer = 3 * self.size, 3 * self.width
        nothing = jnp.zeros(outer, right.dtype)
        padded = jnp.concatenate([right, jnp.zeros((1, 3), right.dtype)])
        parts = factor.inverse, factor.coupling

        def down(left_over, at):
            """`left_over`: of the later right-hand side, by those that are eliminated."""
            own, inverse, coupling = at
            own = own + left_over[:inner]
            half = inverse @ own
            gone = (half if factor.is_definite else own) @ coupling
            return jnp.pad(left_over[inner:], (0, inner)) - gone, half

        def up(after, at):
            """`after`: the solution of the later groups."""
            half, inverse, coupling = at
            rest = half - coupling @ after
            own = rest @ inverse if factor.is_definite else rest
            return jnp.concatenate([own, after])[:outer], own

        own = padded[self.order].reshape(-1, inner)
        _, halves = jax.lax.scan(down, nothing, (own, *parts))
        _, x = jax.lax.scan(up, nothing, (halves, *parts), reverse=True)
        # each vertex occurs once; an addition, since that has a transpose
        return jnp.zeros_like(padded).at[self.order.ravel()].add(x.reshape(-1, 3))[:-1]


def _by_lines(places):
    """Sorted along the longer side, and within a line across it."""
    longer = int(np.argmax(np.ptp(places, axis=0)))
    rounded = np.round(places / max(np.ptp(places), np.finfo(float).tiny), 6)
    return np.lexsort((rounded[:, 1 - longer], rounded[:, longer]))


def _by_neighbours(count, rows, columns):
    """Cuthill and McKee 1969."""
    import scipy.sparse.csgraph  # here, since it takes long to import

    graph = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return scipy.sparse.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)


def _width(order, rows, columns) -> int:
    at = np.argsort(order)
    return max(1, int(np.max(np.abs(at[rows] - at[columns]))))
