"""The curvature tensor of a sheet in elements of a plate, from its bends.

In a triangle mesh an element is a face. Its three hinges see its three neighbours: six vertices, as
many as a quadratic has coefficients. The second derivatives of the quadratic with the curvature of
these hinges are the face's curvature, exact for a sheet of constant curvature on any mesh (as in
the enhanced basic shell triangle of Flores and Oñate 2005, whose patch is the same). A face at the
border of the sheet, which lacks hinges, has the smallest curvature with those of its hinges.

In a grid an element is a vertex. Its line along the warp turns by k11 times the spacing, that along
the weft by k22 times it, and from one side of a cell to the other the sheet twists by k12 times it
(the mean over the two pairs of sides): second differences, each at its own place, so that no wave
of the vertices is free. At the border of the sheet the curvature across it is that of the next
line.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s.mesh.bends import Bends
from r2s.mesh.strain_samples import cells

# Start and end of the axis, ends of the left and the right wing, in terms of a bend's vertices: the
# turn of a line, from its own vertex, the next and the last along it, the next and the last across;
TURN = np.array([[1, 0, 0, 0, 0], [1, 0, 0, 1, -1], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0]], float)
# the twist of a cell between its sides along the warp, and between those along the weft.
TWIST_WARP = np.array([[1, 1, 0, 0, 0], [0, 0, 1, 1, 0], [3, -1, 0, 0, 0], [1, 1, 2, -2, 0]]) / 2
TWIST_WEFT = np.array([[1, 0, 0, 1, 0], [0, 1, 1, 0, 0], [1, -2, 2, 1, 0], [3, 0, 0, -1, 0]]) / 2
SINGULAR = 1e-3  # of the greatest singular value: directions that the hinges do not bend in


class PlateElements(eqx.Module):
    """The elements of a sheet that bends as a plate.

    - `bends`: of the lines, cells or hinges of the sheet.
    - `areas`: rest areas of the elements, [m^2].
    - `vertices`: of each element; its first one is repeated where it has fewer than others.
    - `of_element`: its bends; bend 0, with no share in the curvature, where it has fewer.
    - `places`: which of the bend's vertices each of the element's is; their number for none.
    - `to_curvature`: from the curvatures of the bends to that of the element, (k11, k22, 2 k12).
    """

    bends: Bends
    areas: Float[Array, " element"]
    vertices: Int[Array, "element place"]
    of_element: Int[Array, "element each"]
    places: Int[Array, "element each place"]
    to_curvature: Float[Array, "element 3 each"]

    @classmethod
    def of_triangles(
        cls,
        rest: Float[np.ndarray, "vertex 2"],
        faces: Int[np.ndarray, "face 3"],
        hinges: Int[np.ndarray, "hinge 4"],
        hinge_faces: Int[np.ndarray, "hinge 2"],
        areas: Float[np.ndarray, " face"],
        bends: Bends,
    ) -> "PlateElements":
        """The faces of a mesh at rest [m], with the `bends` of its hinges."""
        # the hinge on the edge opposite to each corner; -1 at the border
        of_face, corner = np.full(faces.shape, -1), faces[hinge_faces] == hinges[:, 2:, None]
        of_face[hinge_faces, np.argmax(corner, axis=2)] = np.arange(len(hinges))[:, None]
        return cls._of(bends, areas, of_face, _from_hinges(rest, hinges, of_face))

    @classmethod
    def of_grid(cls, spacing: tuple[float, float], shape: tuple[int, int]) -> "PlateElements":
        """The vertices of a grid of `shape` vertices, [m] apart along warp and weft."""
        bends, (warp, weft, twist) = _grid_bends(spacing, shape)
        areas = grid_areas(spacing, shape)
        of_element = np.full((*shape, 4), -1)
        if warp:  # the turn nearest to each vertex on its line
            lines = np.arange(warp).reshape(-1, shape[1])
            of_element[..., 0] = np.pad(lines, ((1, 1), (0, 0)), mode="edge")
        if weft:
            lines = warp + np.arange(weft).reshape(-1, shape[0])
            of_element[..., 1] = np.pad(lines, ((1, 1), (0, 0)), mode="edge").T
        of_cells = warp + weft + np.arange(twist).reshape(np.array(shape) - 1)
        of_element[:-1, :-1, 2], of_element[:-1, :-1, 3] = of_cells, of_cells + twist
        to_curvature = np.zeros((*shape, 3, 4))
        to_curvature[..., 0, 0] = to_curvature[..., 1, 1] = 1
        # the twist of a cell counts with the cell's area, at the vertex that is its origin
        to_curvature[..., 2, 2:] = np.sqrt(np.prod(spacing) / areas)[..., None] / 2
        to_curvature *= (of_element >= 0)[:, :, None]
        flat = of_element.reshape(-1, 4), to_curvature.reshape(-1, 3, 4)
        return cls._of(bends, areas.ravel(), *flat)

    @classmethod
    def _of(cls, bends: Bends, areas, of_element, to_curvature) -> "PlateElements":
        vertices, places = _vertices_of_elements(bends, of_element)
        return cls(
            bends=bends,
            areas=jnp.asarray(areas, float),
            vertices=jnp.asarray(vertices, int),
            of_element=jnp.asarray(np.maximum(of_element, 0), int),
            places=jnp.asarray(places, int),
            to_curvature=jnp.asarray(to_curvature, float),
        )

    def curvatures(self, bends: Float[Array, " bend"]) -> Float[Array, "element 3"]:
        """Curvature (k11, k22, 2 k12) [1/m] of the elements from that of all bends [1/m]."""
        if not bends.shape[0]:
            return jnp.zeros((self.of_element.shape[0], 3), bends.dtype)
        return jnp.einsum("eib,eb->ei", self.to_curvature, bends[self.of_element])

    def gradients(self, bends: Float[Array, "bend corner 3"]) -> Float[Array, "element 3 place 3"]:
        """Derivatives of the elements' curvatures in their vertices, from the bends'."""
        if not bends.shape[0]:
            count, _, width = self.places.shape
            return jnp.zeros((count, 3, width, 3), bends.dtype)
        padded = jnp.pad(bends, ((0, 0), (0, 1), (0, 0)))
        of_element = padded[self.of_element[:, :, None], self.places]
        return jnp.einsum("eib,ebva->eiva", self.to_curvature, of_element)


def grid_areas(
    spacing: tuple[float, float], shape: tuple[int, int]
) -> Float[np.ndarray, "along across"]:
    """The share of each vertex in the area of a grid, [m^2]."""
    return np.prod(spacing) * np.outer(*(np.r_[0.5, np.ones(n - 2), 0.5] for n in shape))


def _vertices_of_elements(bends: Bends, of_element) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of each element, and their places in its bends."""
    of_bends = np.asarray(bends.vertices)
    count, none = of_bends.shape
    weights = np.ones((count, 4, none)) if bends.weights is None else np.asarray(bends.weights)
    of_bends = np.where(np.any(weights != 0, axis=1), of_bends, -1)
    # a row of -1 for the bends that do not exist, the last
    listed = np.concatenate([of_bends, np.full((1, none), -1)])[of_element]
    own = [np.unique(row[row >= 0]) for row in listed.reshape(len(of_element), -1)]
    counts = np.array([len(row) for row in own])
    is_one = np.arange(max(1, *counts)) < counts[:, None]
    vertices = np.repeat([[row[0] if len(row) else 0] for row in own], is_one.shape[1], axis=1)
    vertices[is_one] = np.concatenate(own)
    same = vertices[:, None, :, None] == listed[:, :, None, :]  # (element, bend, vertex, of bend)
    same &= is_one[:, None, :, None]
    return vertices, np.where(same.any(axis=-1), same.argmax(axis=-1), none)


def _grid_bends(
    spacing: tuple[float, float], shape: tuple[int, int]
) -> tuple[Bends, tuple[int, int, int]]:
    """Turns of the lines along warp, along weft, then twists of the cells; how many of each."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    warp, warp_weights = _turns(index)
    weft, weft_weights = _turns(index.T)
    twist = cells(shape)
    cell = np.pad(twist, ((0, 0), (0, 1)), mode="edge")
    vertices = np.concatenate([warp, weft, cell, cell])
    # to the left of the axis is what is ahead of it along the weft, but behind it along the warp
    weights = [warp_weights[:, [0, 1, 3, 2]], weft_weights]
    weights += [np.broadcast_to(part, (len(twist), 4, 5)) for part in (TWIST_WARP, TWIST_WEFT)]
    lengths = np.repeat(
        [spacing[0], spacing[1], spacing[1] / 2, spacing[0] / 2],
        [len(warp), len(weft), len(twist), len(twist)],
    )
    bends = Bends(
        vertices=jnp.asarray(vertices, int),
        weights=jnp.asarray(np.concatenate(weights), float),
        per_angle=1 / jnp.asarray(lengths, float),
        rest_curvature=jnp.zeros(len(vertices), float),
    )
    return bends, (len(warp), len(weft), len(twist))


def _turns(index: Int[np.ndarray, "along across"]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and weights of the turns of a grid's lines at their inner vertices.

    The vertices are: the turn's own, the next and the last along the line, the next and the last
    across. The weights are those of its axis across the line, the next and the last along it.
    """
    middle = index[1:-1]
    across = np.pad(index, ((0, 0), (1, 1)), mode="edge")[1:-1]
    parts = middle, index[2:], index[:-2], across[:, 2:], across[:, :-2]
    vertices = np.stack([part.ravel() for part in parts], axis=1)
    weights = np.broadcast_to(TURN, (len(vertices), 4, 5)).copy()
    for at_border in (3, 4):  # the axis begins or ends at the vertex itself
        alone = vertices[:, at_border] == vertices[:, 0]
        weights[alone, :, 0] += weights[alone, :, at_border]
        weights[alone, :, at_border] = 0
    return vertices, weights


def _from_hinges(rest, hinges, of_face) -> Float[np.ndarray, "face 3 3"]:
    """The inverse of what constant curvatures do to the hinges of each face."""
    if not len(hinges):
        return np.zeros((len(of_face), 3, 3))
    of_hinges = np.where(of_face[:, :, None] >= 0, _bent(rest, hinges)[of_face], 0)
    # in the norm of tensors, which no rotation changes: (k11, k22, sqrt(2) k12)
    scale = np.array([1, 1, np.sqrt(2)])
    return scale[:, None] * np.linalg.pinv(of_hinges * scale, rcond=SINGULAR)


def _bent(rest, hinges) -> Float[np.ndarray, "hinge 3"]:
    """The curvature of every hinge under unit k11, k22 and 2 k12, small deflections."""
    x, y = rest[hinges].transpose(2, 0, 1)  # (axis, hinge, corner)
    heights = np.stack([x**2, y**2, x * y], axis=-1) / 2
    start, end, left, right = rest[hinges].transpose(1, 0, 2)
    along = end - start
    length = np.linalg.norm(along, axis=-1)
    slope_along = (heights[:, 1] - heights[:, 0]) / length[:, None]
    jump, width = 0.0, 0.0
    for place, opposite in ((2, left), (3, right)):
        share = np.sum((opposite - start) * along, axis=-1) / length
        cross = along[:, 0] * (opposite - start)[:, 1] - along[:, 1] * (opposite - start)[:, 0]
        height = np.abs(cross) / length
        rise = heights[:, place] - heights[:, 0] - share[:, None] * slope_along
        jump = jump + rise / height[:, None]  # slope away from the edge, on either side
        width = width + height / 2
    return jump / width[:, None]
