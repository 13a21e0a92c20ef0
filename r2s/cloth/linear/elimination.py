"""How the equations of a mesh are solved: blocks of their matrix, and order of elimination."""

import equinox as eqx
import numpy as np

from r2s.cloth.linear.dissection import Level, levels
from r2s.cloth.linear.pattern import Pattern
from r2s.geometry.mesh import Mesh


class Elimination(eqx.Module):
    """What depends on a mesh alone in the solution of its linear systems.

    - `pattern`: the blocks of the matrix.
    - `levels`: the order in which vertices are eliminated, root first.
    - `couples_all`: whether every pair of vertices has a block.
    """

    pattern: Pattern
    levels: tuple[Level, ...]
    couples_all: bool = eqx.field(static=True, default=False)

    @classmethod
    def make(cls, mesh: Mesh, couples_all: bool = False) -> "Elimination":
        """The elimination of a mesh that is not traced, since its sizes follow from the mesh.

        With `couples_all` any two vertices may be coupled, as self-contact does in small meshes.
        """
        rest = np.asarray(mesh.rest)
        elements = {
            "samples": mesh.samples.corners,
            "hinges": mesh.hinges,
            "plate": mesh.plate.vertices,
            "plate_bends": mesh.plate.bends.vertices,
        }
        elements = {kind: np.asarray(vertices) for kind, vertices in elements.items()}
        pattern = Pattern.make(len(rest), elements, is_full=couples_all)
        rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
        leaf = {"leaf": len(rest)} if couples_all else {}
        return cls(pattern, levels(rest, rows, columns, **leaf), couples_all)
