"""The curvature of a sheet at each of its faces, from the hinges around it.

The three hinges of a triangle see its three neighbours: six vertices, as many as a quadratic has
coefficients. So there is one quadratic that bends the three hinges as they are bent, and its second
derivatives are the face's curvature, exact for a sheet of constant curvature on any mesh (as in the
enhanced basic shell triangle of Flores and Oñate 2005, whose patch is the same). Where a face lies
at the border of the sheet and lacks hinges, it is the smallest curvature that bends those it has.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

SINGULAR = 1e-3  # of the greatest singular value: directions that the hinges do not see


class Patches(eqx.Module):
    """The faces of a mesh with the hinges on their edges.

    - `vertices`: the corners of each face, then the vertex beyond the edge opposite to each corner.
      Where there is none, the first corner stands for it.
    - `hinges`: opposite to each corner. Where there is none, hinge 0, with no share in curvature.
    - `corners`: which of the hinge's four vertices each of the patch's is; 4: none of them.
    - `to_curvature`: from the curvatures of the hinges to that of the face, (k11, k22, 2 k12).
    """

    vertices: Int[Array, "face 6"]
    hinges: Int[Array, "face 3"]
    corners: Int[Array, "face 3 6"]
    to_curvature: Float[Array, "face 3 3"]

    @classmethod
    def make(
        cls,
        rest: Float[np.ndarray, "vertex 2"],
        faces: Int[np.ndarray, "face 3"],
        hinges: Int[np.ndarray, "hinge 4"],
    ) -> "Patches":
        """The patches of a mesh at rest [m]."""
        of_face = _hinges_of_faces(faces, hinges)
        exists = of_face >= 0
        listed = np.concatenate([hinges.reshape(-1, 4), np.full((1, 4), -1)])
        four = listed[of_face]  # a row of -1 where there is no hinge, the last
        # the hinge's opposite vertices are the face's own corner and the one beyond
        beyond = np.where(four[:, :, 2] == faces, four[:, :, 3], four[:, :, 2])
        beyond = np.where(exists, beyond, faces[:, :1])
        vertices = np.concatenate([faces, beyond], axis=1)
        same = vertices[:, None, :, None] == four[:, :, None, :]  # (face, hinge, patch, of hinge)
        same[:, :, 3:] &= np.eye(3, dtype=bool)[None, :, :, None]  # each only beyond its own edge
        corners = np.where(same.any(axis=-1), same.argmax(axis=-1), 4)
        return cls(
            vertices=jnp.asarray(vertices, int),
            hinges=jnp.asarray(np.maximum(of_face, 0), int),
            corners=jnp.asarray(corners, int),
            to_curvature=jnp.asarray(_to_curvature(rest, hinges, of_face), float),
        )

    def curvatures(self, hinges: Float[Array, " hinge"]) -> Float[Array, "face 3"]:
        """Curvature (k11, k22, 2 k12) [1/m] of the faces from that of all hinges [1/m]."""
        if not hinges.shape[0]:
            return jnp.zeros((self.hinges.shape[0], 3), hinges.dtype)
        return jnp.einsum("fih,fh->fi", self.to_curvature, hinges[self.hinges])

    def gradients(self, hinges: Float[Array, "hinge 4 3"]) -> Float[Array, "face 3 6 3"]:
        """Derivatives of the faces' curvatures in their patches' vertices, from the hinges'."""
        padded = jnp.pad(hinges, ((0, 0), (0, 1), (0, 0)))
        of_patch = padded[self.hinges[:, :, None], self.corners]
        return jnp.einsum("fih,fhva->fiva", self.to_curvature, of_patch)


def _hinges_of_faces(faces, hinges) -> Int[np.ndarray, "face 3"]:
    """The hinge on the edge opposite to each corner; -1 at the border."""
    index = {tuple(sorted(ends)): hinge for hinge, ends in enumerate(hinges[:, :2].tolist())}
    others = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    found = [index.get(tuple(ends), -1) for ends in others.reshape(-1, 2).tolist()]
    return np.reshape(found, (-1, 3))


def _to_curvature(rest, hinges, of_face) -> Float[np.ndarray, "face 3 3"]:
    """The inverse of what constant curvatures do to the hinges of each face."""
    if not len(hinges):
        return np.zeros((len(of_face), 3, 3))
    seen = np.where(of_face[:, :, None] >= 0, _bent(rest, hinges)[of_face], 0)
    # in the norm of tensors, which no rotation changes: (k11, k22, sqrt(2) k12)
    scale = np.array([1, 1, np.sqrt(2)])
    return scale[:, None] * np.linalg.pinv(seen * scale, rcond=SINGULAR)


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
