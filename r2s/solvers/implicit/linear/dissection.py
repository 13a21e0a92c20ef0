"""Nested dissection: an order of elimination that keeps the factor of a mesh's matrix sparse.

A set of vertices is cut in two halves that share no element by a separator, and the halves again,
to a fixed depth. The halves are eliminated first, then the separator (George 1973). All nodes of
one depth are eliminated together, as one batch of small dense matrices (fronts; Duff and Reid
1983), padded to the size of the largest.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

LEAF = 20  # vertices, about, that are not cut any further


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


def levels(
    places: np.ndarray, rows: np.ndarray, columns: np.ndarray, leaf: int = LEAF
) -> tuple[Level, ...]:
    """The levels, root first, for vertices at `places` (vertex, axis) and the blocks of a matrix.

    `places` decide where sets are cut, at medians; `rows` and `columns` are those of all its
    blocks, sorted. Scaling an axis changes nothing.
    """
    import scipy.sparse  # here, since it would take a third of the time that r2s takes to import

    count = len(places)
    numbers = np.arange(1, len(rows) + 1)  # not zero, which a sparse matrix would drop
    graph = scipy.sparse.csr_matrix((numbers, (rows, columns)), shape=(count, count))
    depth = max(0, int(np.floor(np.log2(max(count, 1) / leaf))))
    pivots = _tree(places, graph, depth)
    boundaries = _boundaries(pivots, graph)
    return tuple(_level(graph, pivots, boundaries, level) for level in range(depth + 1))


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
    below: list[np.ndarray] = []
    inside: list[np.ndarray] = []
    for nodes in reversed(pivots):
        coupled = [np.unique(graph[vertices].indices) for vertices in nodes]
        if below:
            pairs = range(0, len(below), 2)
            coupled = [
                np.unique(np.concatenate([own, below[i], below[i + 1]]))
                for own, i in zip(coupled, pairs, strict=True)
            ]
            inside = [
                np.concatenate([own, inside[i], inside[i + 1]])
                for own, i in zip(nodes, pairs, strict=True)
            ]
        else:
            inside = list(nodes)
        below = [np.setdiff1d(all_, done) for all_, done in zip(coupled, inside, strict=True)]
        boundaries.append(below)
    return boundaries[::-1]


def _level(graph, pivots, boundaries, level) -> Level:
    count = graph.shape[0]
    inner, outer = _padded(pivots[level], count), _padded(boundaries[level], count)
    front = np.concatenate([inner, outer], axis=1)
    nodes, size = front.shape
    blocks = np.full((nodes, inner.shape[1], size), graph.nnz)
    for node, vertices in enumerate(pivots[level]):
        here = graph[vertices].tocoo()
        slots = np.full(count, -1)
        slots[boundaries[level][node]] = inner.shape[1] + np.arange(len(boundaries[level][node]))
        slots[vertices] = np.arange(len(vertices))
        kept = slots[here.col] >= 0  # blocks with what is already eliminated are in the children
        blocks[node, here.row[kept], slots[here.col[kept]]] = here.data[kept] - 1
    children = np.zeros((nodes, 0, size), int)
    if level + 1 < len(pivots):
        below = boundaries[level + 1]
        none = max(len(vertices) for vertices in below)
        children = np.full((nodes, 2, size), none)
        for node in range(nodes):
            for side in range(2):
                slots = np.full(count + 1, none)
                vertices = below[2 * node + side]
                slots[vertices] = np.arange(len(vertices))
                children[node, side] = slots[front[node]]
    return Level(*(jnp.asarray(array, int) for array in (inner, outer, blocks, children)))


def _padded(parts: list[np.ndarray], filler: int) -> np.ndarray:
    width = max(len(part) for part in parts)
    padded = np.full((len(parts), width), filler)
    for row, part in zip(padded, parts, strict=True):
        row[: len(part)] = part
    return padded
