"""Neighbours: which parts of a sheet may meet in a motion, by boxes around what they sweep.

A pair is a vertex and a triangle, or two edges, that share no vertex (`proximity`). Small meshes
search among `all_pairs`; large ones in a tree of boxes around their faces, which finds the same.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Pairs(eqx.Module):
    """Pairs of parts of a sheet, in a list of fixed size.

    - `stencils`: vertex-triangle: the vertex, then the corners; edge-edge: the ends of one edge,
      then those of the other.
    - `is_edges`: which are edge-edge.
    - `is_real`: which are pairs at all; the others fill up the list, with vertex 0 four times.
    """

    stencils: Int[Array, "pair 4"]
    is_edges: Bool[Array, " pair"]
    is_real: Bool[Array, " pair"]


class BVH(eqx.Module):
    """A complete binary tree over the faces of a sheet, nearby ones on nearby leaves.

    Every vertex and every edge is owned by one face that has it, so that the pairs of owned parts
    of two faces, over all two faces, are all pairs, each once. -1 stands for none.

    - `faces`: the corners of the faces.
    - `leaves`: the face of each leaf.
    - `vertices`: that each face owns.
    - `edges`: that each face owns, by their two ends, the lower first.
    """

    faces: Int[Array, "face 3"]
    leaves: Int[Array, " leaf"]
    vertices: Int[Array, "face owned_vertex"]
    edges: Int[Array, "face owned_edge 2"]

    @property
    def depth(self) -> int:
        """The level of the leaves; that of the root is 0."""
        return int(self.leaves.shape[0]).bit_length() - 1


def all_pairs(faces: Int[np.ndarray, "face 3"]) -> Pairs:
    """Every pair of a mesh, some 5.5 V^2 for V vertices; the edges by their ends, lower first.

    Raises `ValueError` when there is none.
    """
    faces = np.asarray(faces)
    ends, _ = _edges(faces)
    vertex, face = (axis.ravel() for axis in np.indices((faces.max() + 1, len(faces))))
    first, second = np.triu_indices(len(ends), 1)
    met = np.concatenate([vertex[:, None], faces[face]], axis=1)
    crossed = np.concatenate([ends[first], ends[second]], axis=1)
    met = met[np.all(met[:, :1] != met[:, 1:], axis=1)]
    crossed = crossed[np.all(crossed[:, :2, None] != crossed[:, None, 2:], axis=(1, 2))]
    is_edges = np.arange(len(met) + len(crossed)) >= len(met)
    if not len(is_edges):
        raise ValueError(f"a mesh of {len(faces)} face(s) has no pairs that share no vertex")
    stencils = jnp.asarray(np.concatenate([met, crossed]), int)
    return Pairs(stencils, jnp.asarray(is_edges), jnp.ones(len(is_edges), bool))


def candidate_pairs(
    pairs: Pairs,
    start: Float[Array, "vertex 3"],
    end: Float[Array, "vertex 3"],
    reach: Float[Array, ""],
    capacity: int,
) -> tuple[Pairs, Bool[Array, ""]]:
    """Those of the pairs that may come within `reach` [m] in a straight motion of the vertices [m].

    That is, along each axis the boxes around what the two sweep come as close. In the order of
    `pairs`. Also whether there are more than `capacity`; the last ones are then left out.
    """
    low, high = jnp.minimum(start, end), jnp.maximum(start, end)
    is_near = pairs.is_real
    for axis in range(3):  # apart, as it is several times as fast as all at once
        low_first, low_second = _of_bodies(jnp.minimum, low[:, axis], pairs)
        high_first, high_second = _of_bodies(jnp.maximum, high[:, axis], pairs)
        is_near &= (low_first <= high_second + reach) & (low_second <= high_first + reach)
    index, is_real, is_over = _compact(is_near, capacity)
    stencils = jnp.where(is_real[:, None], pairs.stencils[index], 0)
    return Pairs(stencils, pairs.is_edges[index] & is_real, is_real), is_over


def build_bvh(faces: Int[np.ndarray, "face 3"], rest: Float[np.ndarray, "vertex axis"]) -> BVH:
    """A tree for a mesh with its vertices at `rest` [m], split at medians of the longer sides."""
    faces = np.asarray(faces)
    depth = (len(faces) - 1).bit_length()
    leaves = _leaves(np.asarray(rest)[faces].mean(axis=1), np.arange(len(faces)), depth)
    ends, of_faces = _edges(faces)
    owned = _owned(of_faces)
    edges = np.where(owned[:, :, None] < 0, -1, ends[owned])
    return BVH(*(jnp.asarray(array, int) for array in (faces, leaves, _owned(faces), edges)))


def candidate_pairs_in_tree(
    tree: BVH,
    start: Float[Array, "vertex 3"],
    end: Float[Array, "vertex 3"],
    reach: Float[Array, ""],
    capacity: int,
    node_capacity: int,
) -> tuple[Pairs, Bool[Array, ""]]:
    """What `candidate_pairs` finds among all pairs, in another order, without looking at them all.

    From level to level down the tree it keeps those pairs of nodes whose boxes come within reach,
    at most `node_capacity`; that there were more counts as overflow too.
    """
    first, second, is_real, is_over = _near_faces(tree, start, end, reach, node_capacity)
    owned = _of_faces(tree, first, second, is_real)
    near, is_over_too = candidate_pairs(owned, start, end, reach, capacity)
    return near, is_over | is_over_too


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a mesh by their ends, in ascending order, and which of them each face has."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    ends, index = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    return ends, index.reshape(-1, 3)


def _leaves(centres: np.ndarray, faces: np.ndarray, depth: int) -> list[int]:
    """The faces in the order of the leaves below a node, padded."""
    if depth == 0 or not len(faces):
        return faces.tolist() + [-1] * (2**depth - len(faces))
    axis = np.argmax(np.ptp(centres[faces], axis=0))
    faces = faces[np.argsort(centres[faces, axis], kind="stable")]
    half = (len(faces) + 1) // 2
    halves = faces[:half], faces[half:]
    return sum((_leaves(centres, part, depth - 1) for part in halves), [])


def _owned(parts: Int[np.ndarray, "face 3"]) -> Int[np.ndarray, "face owned"]:
    """Parts (of which every face has three) shared out to their faces, as evenly as can be."""
    from scipy.sparse import csr_array  # here, since it takes long to import
    from scipy.sparse.csgraph import maximum_bipartite_matching

    count = parts.max() + 1
    for width in (1, 2, 3):  # a matching of the parts with places in the faces
        place = np.arange(len(parts) * width).reshape(-1, 1, width)
        part, place = (a.ravel() for a in np.broadcast_arrays(parts[:, :, None], place))
        graph = csr_array((np.ones(len(part)), (part, place)), (count, len(parts) * width))
        matched = maximum_bipartite_matching(graph, perm_type="column")
        if np.all(matched >= 0):
            break
    owned = np.full(len(parts) * width, -1)
    owned[matched] = np.arange(count)
    return owned.reshape(-1, width)


def _near_faces(tree, start, end, reach, capacity):
    """Pairs of faces whose boxes come within reach; which are real; whether there were more."""
    corners, is_face = tree.faces[tree.leaves], (tree.leaves >= 0)[:, None]
    low = jnp.minimum(start, end)[corners].min(axis=1)
    high = jnp.maximum(start, end)[corners].max(axis=1)
    # inside out where there is no face
    levels = [(jnp.where(is_face, low, jnp.inf), jnp.where(is_face, high, -jnp.inf))]
    for _ in range(tree.depth):
        low, high = levels[0]
        levels.insert(0, (low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1)))
    fitting = (
        level for level in range(tree.depth + 1) if 2**level * (2**level + 1) // 2 <= capacity
    )
    top = max(fitting, default=0)
    first, second = (jnp.asarray(index) for index in np.triu_indices(2**top))
    is_real, is_over = jnp.ones(len(first), bool), jnp.zeros((), bool)
    for level in range(top, tree.depth + 1):
        if level > top:
            first, second, is_real = _children(first, second, is_real)
        low, high = levels[level]
        is_near = (low[first] <= high[second] + reach) & (low[second] <= high[first] + reach)
        is_real &= jnp.all(is_near, axis=1) & ((level < tree.depth) | (first != second))
        index, is_real, is_more = _compact(is_real, capacity)
        first, second, is_over = first[index], second[index], is_over | is_more
    return tree.leaves[first], tree.leaves[second], is_real, is_over


def _children(first, second, is_real):
    """The pairs of the children of pairs of nodes, the first not above the second."""
    firsts = 2 * first[:, None] + jnp.array([[0, 0, 1, 1]])
    seconds = 2 * second[:, None] + jnp.array([[0, 1, 0, 1]])
    are_real = is_real[:, None] & (firsts <= seconds)
    return firsts.ravel(), seconds.ravel(), are_real.ravel()


def _of_faces(tree: BVH, first, second, is_real) -> Pairs:
    """The pairs of what two faces own, for pairs of faces."""
    stencils, is_edges = [], []
    for own, other in ((first, second), (second, first)):
        for vertex in tree.vertices[own].T:
            stencils.append(jnp.concatenate([vertex[:, None], tree.faces[other]], axis=1))
            is_edges.append(False)
    for one in tree.edges[first].transpose(1, 0, 2):
        for other in tree.edges[second].transpose(1, 0, 2):
            is_ordered = one[:, :1] < other[:, :1]
            lower, higher = jnp.where(is_ordered, one, other), jnp.where(is_ordered, other, one)
            stencils.append(jnp.concatenate([lower, higher], axis=1))
            is_edges.append(True)
    of_edges = jnp.repeat(jnp.asarray(is_edges), len(first))
    corners = jnp.concatenate(stencils)
    a, b, c, d = corners.T
    is_apart = (a != c) & (a != d) & (b != jnp.where(of_edges, c, a)) & (~of_edges | (b != d))
    is_owned = jnp.all(corners >= 0, axis=1)
    return Pairs(corners, of_edges, jnp.tile(is_real, len(stencils)) & is_apart & is_owned)


def _of_bodies(extreme, coordinates, pairs: Pairs):
    """The least or greatest coordinate of the corners of each of the two bodies."""
    a, b, c, d = (coordinates[corner] for corner in pairs.stencils.T)
    first, second = extreme(a, b), extreme(c, d)
    return jnp.where(pairs.is_edges, first, a), jnp.where(
        pairs.is_edges, second, extreme(second, b)
    )


def _compact(mask, capacity):
    """Where a mask is set, in order and padded; which of them are real; whether there are more."""
    upto = jnp.cumsum(mask)
    place = jnp.arange(capacity)
    is_real = place < upto[-1]
    index = jnp.searchsorted(upto, place + 1)  # `nonzero`, but several times as fast on a CPU
    return jnp.where(is_real, index, 0), is_real, upto[-1] > capacity
