"""Nested dissection: an order of elimination that keeps the factor of a mesh's matrix sparse.

A set of vertices is cut in two halves that share no element by a separator, and the halves again,
to a fixed depth. The halves are eliminated first, then the separator (George 1973). All nodes of
one depth are eliminated together, as one batch of small dense matrices (fronts; Duff and Reid
1983), padded to the size of the largest.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

LEAF = 20  # vertices, about, that are not cut any further
Vectors = Float[Array, "vertex 3"]


class Level(eqx.Module):
    """The nodes of one depth of the tree; padding is the number of vertices.

    - `pivots`: the vertices eliminated here.
    - `boundary`: the vertices, eliminated later, which these are then coupled to.
    - `blocks`: the block of the matrix that couples a pivot with each vertex of the front (pivots,
      then boundary), or the number of blocks when there is none.
    - `children`: for the two children of each node, where in their boundary each vertex of the
      front is, or the size of their boundary when it is not there. Empty at the leaves.
    """

    pivots: Int[Array, "node pivot"]
    boundary: Int[Array, "node outer"]
    blocks: Int[Array, "node pivot front"]
    children: Int[Array, "node child front"]


class FrontFactor(eqx.Module):
    """The factor of one level's fronts.

    - `inverse`: of the block of the pivots.
    - `coupling`: `inverse` times the block of pivots and boundary.
    """

    inverse: Float[Array, "node pivot pivot"]
    coupling: Float[Array, "node pivot outer"]


class Dissection(eqx.Module):
    """An order of vertices by nested dissection: the levels of its tree, root first."""

    levels: tuple[Level, ...]

    @classmethod
    def make(
        cls,
        places: Float[np.ndarray, "vertex axis"],
        rows: Int[np.ndarray, " block"],
        columns: Int[np.ndarray, " block"],
        leaf: int = LEAF,
    ) -> "Dissection":
        """Of the vertices at `places`, at whose medians sets are cut.

        `rows` and `columns` are those of all blocks of the matrix, sorted; `leaf` is the number of
        vertices, about, that are not cut. Scaling an axis changes nothing.
        """
        import scipy.sparse  # here, since its import takes long

        count = len(places)
        numbers = np.arange(1, len(rows) + 1)  # not zero, which a sparse matrix would drop
        graph = scipy.sparse.csr_matrix((numbers, (rows, columns)), shape=(count, count))
        depth = max(0, int(np.floor(np.log2(max(count, 1) / leaf))))
        pivots = _tree(places, graph, depth)
        boundaries = _boundaries(pivots, graph)
        return cls(tuple(_level(graph, pivots, boundaries, level) for level in range(depth + 1)))

    def factor(
        self, blocks: Float[Array, "block 3 3"], is_definite: bool = True
    ) -> tuple[FrontFactor, ...]:
        """The factors of all levels, as `Band.factor`; without `is_definite` it pivots inside the
        fronts.
        """
        blocks = jnp.concatenate([blocks, jnp.zeros((1, 3, 3), blocks.dtype)])
        factors: list[FrontFactor] = []
        schur = None
        for level in reversed(self.levels):
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

    def solve(self, factors: Sequence[FrontFactor], right: Vectors) -> Vectors:
        """The solution of the factored matrix times x = `right`."""
        # padding stays zero: it is coupled to nothing
        b = jnp.concatenate([right, jnp.zeros((1, 3), right.dtype)])
        levels = list(zip(self.levels, factors, strict=True))
        for level, part in reversed(levels):
            b = b.at[level.boundary].add(-_times(part.coupling.mT, b[level.pivots]))
        x = jnp.zeros_like(b)
        for level, part in levels:
            alone = _times(part.inverse, b[level.pivots])
            coupled = _times(part.coupling, x[level.boundary])
            # each vertex is a pivot once; an addition, since that has a transpose
            x = x.at[level.pivots].add(alone - coupled)
        return x[:-1]


def _tree(places, graph, depth) -> list[list[np.ndarray]]:
    """Sorted pivots of each node, by level from the root; node k has the children 2 k, 2 k + 1."""
    pending, tree = [np.arange(len(places))], []
    for _ in range(depth):
        cuts = [_cut(places, graph, vertices) for vertices in pending]
        tree.append([separator for separator, _, _ in cuts])
        pending = [half for _, low, high in cuts for half in (low, high)]
    return [*tree, pending]


def _cut(places, graph, vertices):
    """A separator and two halves, along the axis where the separator is smallest."""
    candidates = []
    for axis in range(places.shape[1]):
        along = places[vertices, axis]
        middle = np.median(along) if len(along) else 0.0
        low, high = vertices[along < middle], vertices[along >= middle]
        touched = np.unique(graph[low].indices)
        separator = np.intersect1d(high, touched, assume_unique=True)
        candidates.append((separator, low, np.setdiff1d(high, separator, assume_unique=True)))
    # an axis along which all lie together cuts nothing off
    useful = [cut for cut in candidates if len(cut[1])]
    return min(useful or candidates, key=lambda cut: len(cut[0]))


def _boundaries(pivots, graph) -> list[list[np.ndarray]]:
    """For each node, the sorted vertices outside that it is coupled to once it is eliminated."""
    boundaries: list[list[np.ndarray]] = []
    none = np.zeros(0, int)
    below = inside = [none] * (2 * len(pivots[-1]))  # of the children of the leaves
    for nodes in reversed(pivots):
        children = range(0, len(below), 2)
        parts = [graph[vertices].indices for vertices in nodes]
        coupled = [
            np.unique(np.concatenate([own, below[i], below[i + 1]]))
            for own, i in zip(parts, children, strict=True)
        ]
        inside = [
            np.concatenate([own, inside[i], inside[i + 1]])
            for own, i in zip(nodes, children, strict=True)
        ]
        below = [np.setdiff1d(*pair) for pair in zip(coupled, inside, strict=True)]
        boundaries.append(below)
    return boundaries[::-1]


def _level(graph, pivots, boundaries, level) -> Level:
    count = graph.shape[0]
    inner, outer = _padded(pivots[level], count), _padded(boundaries[level], count)
    front = np.concatenate([inner, outer], axis=1)
    nodes, size = front.shape
    blocks = np.full((nodes, inner.shape[1], size), graph.nnz)
    for node, vertices in enumerate(pivots[level]):
        coupled = graph[vertices].tocoo()
        slots = np.full(count, -1)
        slots[boundaries[level][node]] = inner.shape[1] + np.arange(len(boundaries[level][node]))
        slots[vertices] = np.arange(len(vertices))
        kept = slots[coupled.col] >= 0  # blocks with eliminated vertices are in the children
        blocks[node, coupled.row[kept], slots[coupled.col[kept]]] = coupled.data[kept] - 1
    children = np.zeros((nodes, 0, size), int)
    if level + 1 < len(pivots):
        below = boundaries[level + 1]
        none = max(len(vertices) for vertices in below)
        children = np.full((nodes, 2, size), none)
        for child, vertices in enumerate(below):
            slots = np.full(count + 1, none)
            slots[vertices] = np.arange(len(vertices))
            children[child // 2, child % 2] = slots[front[child // 2]]
    return Level(*(jnp.asarray(array, int) for array in (inner, outer, blocks, children)))


def _padded(parts: list[np.ndarray], filler: int) -> np.ndarray:
    width = max(len(part) for part in parts)
    padded = np.full((len(parts), width), filler)
    for row, part in zip(padded, parts, strict=True):
        row[: len(part)] = part
    return padded


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


def _times(matrices: Array, vectors: Float[Array, "node _ 3"]) -> Float[Array, "node _ 3"]:
    flat = vectors.reshape(len(vectors), -1)
    return jnp.einsum("nij,nj->ni", matrices, flat).reshape(len(vectors), -1, 3)
