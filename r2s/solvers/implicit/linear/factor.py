"""The factor of a sparse symmetric matrix of blocks, by the order in which it is eliminated."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s.solvers.implicit.linear.dissection import Level

GROUP = 6  # of the width: how much of it a group has


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
        size: int | None = None,
    ) -> "Band":
        """Of the vertices at `places`, by lines across or by neighbours, what is narrower.

        `rows` and `columns` are those of all blocks of the matrix; `size` is that of a group.
        """
        orders = [_by_lines(places), _by_neighbours(len(places), rows, columns)]
        order, width = min(
            ((each, _width(each, rows, columns)) for each in orders), key=lambda each: each[1]
        )
        size = min(size or max(1, round(width / GROUP)), width)
        at, groups = np.argsort(order), -(-len(order) // size)
        padded = np.full(groups * size, len(order))
        padded[: len(order)] = order
        group = at[rows] // size
        kept = np.flatnonzero(at[columns] >= group * size)  # the others are in earlier groups' rows
        row, column = (at[each] - group * size for each in (rows, columns))
        arrays = padded.reshape(groups, size), kept, group[kept], row[kept], column[kept]
        return cls(
            *(jnp.asarray(each, int) for each in arrays),
            count=len(order),
            size=int(size),
            width=int(width),
        )


class BandFactor(eqx.Module):
    """The factor of all groups.

    - `inverse`: of the block of the pivots, or of its lower triangular root if `is_definite`.
    - `coupling`: that inverse times the block of pivots and what follows.
    """

    inverse: Float[Array, "group pivot pivot"]
    coupling: Float[Array, "group pivot outer"]
    is_definite: bool = eqx.field(static=True)


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


def factor_band(
    band: Band, blocks: Float[Array, "block 3 3"], is_definite: bool = True
) -> BandFactor:
    """As `factor.factor`; without `is_definite` it pivots inside groups."""
    inner, outer = 3 * band.size, 3 * band.width
    unit = jnp.eye(inner, dtype=blocks.dtype)

    def eliminate(left_over, rows):
        """`left_over`: of the vertices from this group on, by those that are eliminated."""
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
    _, (inverse, coupling) = jax.lax.scan(eliminate, none, _rows(band, blocks))
    return BandFactor(inverse, coupling, is_definite)


def _rows(band: Band, blocks: Float[Array, "block 3 3"]) -> Float[Array, "group pivot front"]:
    """The rows of each group from its first vertex on; those of padding are of the identity."""
    groups, front = len(band.order), band.size + band.width
    rows = jnp.zeros((groups, band.size, 3, front, 3), blocks.dtype)
    rows = rows.at[band.group, band.row, :, band.column].set(blocks[band.kept], unique_indices=True)
    rows = rows.reshape(groups, 3 * band.size, 3 * front)
    padding = jnp.repeat((band.order == band.count).astype(blocks.dtype), 3, axis=1)
    return rows + padding[:, :, None] * jnp.eye(*rows.shape[1:], dtype=blocks.dtype)[None]


def solve_band(
    band: Band, factor: BandFactor, right: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The solution of the factored matrix times x = `right`."""
    inner, outer = 3 * band.size, 3 * band.width
    nothing = jnp.zeros(outer, right.dtype)
    padded = jnp.concatenate([right, jnp.zeros((1, 3), right.dtype)])
    parts = factor.inverse, factor.coupling

    def down(left_over, at):
        """`left_over`: of the right-hand side from this group on, by those that are eliminated."""
        own, inverse, coupling = at
        own = own + left_over[:inner]
        half = inverse @ own
        gone = (half if factor.is_definite else own) @ coupling
        return jnp.pad(left_over[inner:], (0, inner)) - gone, half

    def up(after, at):
        """`after`: the solution from the next group on."""
        half, inverse, coupling = at
        rest = half - coupling @ after
        own = rest @ inverse if factor.is_definite else rest
        return jnp.concatenate([own, after])[:outer], own

    own = padded[band.order].reshape(-1, inner)
    _, halves = jax.lax.scan(down, nothing, (own, *parts))
    _, x = jax.lax.scan(up, nothing, (halves, *parts), reverse=True)
    # each vertex is there once; an addition, since that has a transpose
    return jnp.zeros_like(padded).at[band.order.ravel()].add(x.reshape(-1, 3))[:-1]


class FrontFactor(eqx.Module):
    """The factor of one level's fronts.

    - `inverse`: of the block of the pivots.
    - `coupling`: `inverse` times the block of pivots and boundary.
    """

    inverse: Float[Array, "node pivot pivot"]
    coupling: Float[Array, "node pivot outer"]


def factor_fronts(
    levels: Sequence[Level], blocks: Float[Array, "block 3 3"], is_definite: bool = True
) -> tuple[FrontFactor, ...]:
    """The factors of all levels, root first, as `factor.factor` makes them.

    Without `is_definite` it pivots inside the fronts.
    """
    blocks = jnp.concatenate([blocks, jnp.zeros((1, 3, 3), blocks.dtype)])
    factors: list[FrontFactor] = []
    schur = None
    for level in reversed(levels):
        inner = 3 * level.pivots.shape[1]
        rows = _pivot_rows(level, blocks)
        rest = jnp.zeros((), blocks.dtype)
        if schur is not None:
            left_over = _from_children(level, schur)
            rows, rest = rows + left_over[:, :inner], left_over[:, inner:, inner:]
        inverse = _inverses(rows[:, :, :inner], is_definite)
        coupling = inverse @ rows[:, :, inner:]
        schur = rest - rows[:, :, inner:].mT @ coupling
        factors.append(FrontFactor(inverse, coupling))
    return tuple(factors[::-1])


def solve_fronts(
    levels: Sequence[Level], factors: Sequence[FrontFactor], right: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The solution of the factored matrix times x = `right`."""
    # padding stays zero: it is coupled to nothing
    b = jnp.concatenate([right, jnp.zeros((1, 3), right.dtype)])
    for level, part in zip(reversed(levels), reversed(factors), strict=True):
        b = b.at[level.boundary].add(-_unflat(_times(part.coupling.mT, _flat(b[level.pivots]))))
    x = jnp.zeros_like(b)
    for level, part in zip(levels, factors, strict=True):
        alone = _times(part.inverse, _flat(b[level.pivots]))
        coupled = _times(part.coupling, _flat(x[level.boundary]))
        # each vertex is a pivot once; an addition, since that has a transpose
        x = x.at[level.pivots].add(_unflat(alone - coupled))
    return x[:-1]


def _pivot_rows(level: Level, blocks: Array) -> Array:
    """The matrix's rows of the pivots, those of padding from the identity."""
    nodes, pivots, front = level.blocks.shape
    rows = blocks[level.blocks].transpose(0, 1, 3, 2, 4).reshape(nodes, 3 * pivots, 3 * front)
    # where a pivot has no block with itself, it is padding
    own = jnp.diagonal(level.blocks[:, :, :pivots], axis1=1, axis2=2)
    padding = jnp.repeat((own == blocks.shape[0] - 1).astype(blocks.dtype), 3, axis=1)
    return rows + padding[:, :, None] * jnp.eye(3 * pivots, 3 * front, dtype=blocks.dtype)[None]


def _from_children(level: Level, schur: Array) -> Array:
    """The sum of the children's Schur complements, each at its place in the parent's front."""
    nodes, _, front = level.children.shape
    width = schur.shape[-1]
    schur = jnp.pad(schur, ((0, 0), (0, 3), (0, 3))).reshape(nodes, 2, width + 3, width + 3)
    places = jnp.repeat(3 * level.children, 3, axis=2) + jnp.tile(jnp.arange(3), front)[None, None]
    pick = jax.vmap(jax.vmap(lambda matrix, place: matrix[place][:, place]))
    return jnp.sum(pick(schur, places), axis=1)


def _inverses(pivots: Array, is_definite: bool) -> Array:
    """The inverses of a batch of symmetric matrices."""

    def definite(matrix):
        lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
        unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
        inverse = jax.scipy.linalg.solve_triangular(lower, unit, lower=True)
        return inverse.T @ inverse

    one = definite if is_definite else jnp.linalg.inv
    if pivots.shape[0] == 1:
        return one(pivots[0])[None]
    if jax.default_backend() == "cpu":
        return jax.lax.map(one, pivots)  # jaxlib 0.10.1 can hang in a batched factorisation
    return jax.vmap(one)(pivots)


def _times(matrices: Array, vectors: Array) -> Array:
    return jnp.einsum("nij,nj->ni", matrices, vectors)


def _flat(vectors: Array) -> Array:
    return vectors.reshape(vectors.shape[0], -1)


def _unflat(vectors: Array) -> Array:
    return vectors.reshape(vectors.shape[0], -1, 3)


Order = Band | tuple[Level, ...]
Factor = BandFactor | tuple[FrontFactor, ...]


def factor(order: Order, blocks: Float[Array, "block 3 3"], is_definite: bool = True) -> Factor:
    """The factor of a matrix.

    With `is_definite` by Cholesky: NaN when the matrix is not positive definite. Without, by
    elimination with pivoting among vertices that are eliminated together, for any symmetric matrix
    but a singular one.
    """
    if isinstance(order, Band):
        return factor_band(order, blocks, is_definite)
    return factor_fronts(order, blocks, is_definite)


def solve(
    order: Order, factor: Factor, right: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The solution of the factored matrix times x = `right`."""
    if isinstance(order, Band):
        assert isinstance(factor, BandFactor)
        return solve_band(order, factor, right)
    assert not isinstance(factor, BandFactor)
    return solve_fronts(order, factor, right)
