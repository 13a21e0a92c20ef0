"""How the equations of a mesh are solved: blocks of their matrix, and order of elimination."""

from typing import Literal

import equinox as eqx
import jax
import numpy as np

from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.linear.band import Band
from r2s.solvers.implicit.linear.dissection import levels
from r2s.solvers.implicit.linear.factor import Order
from r2s.solvers.implicit.linear.pattern import Pattern

WIDEST = 160  # vertices: of wider bands nested dissection is faster


class Elimination(eqx.Module):
    """What depends on a mesh alone in the solution of its linear systems.

    - `pattern`: the blocks of the matrix.
    - `order`: in which vertices are eliminated: a band where it is narrow, or by dissection.
    - `couples_all`: whether every pair of vertices has a block.
    """

    pattern: Pattern
    order: Order
    couples_all: bool = eqx.field(static=True, default=False)

    @classmethod
    def make(
        cls,
        mesh: Mesh,
        couples_all: bool = False,
        order: Literal["band", "dissection"] | None = None,
    ) -> "Elimination":
        """The elimination of a mesh that is not traced, since its sizes follow from the mesh.

        With `couples_all` any two vertices may be coupled, as self-contact does in small meshes:
        then there is no `order` to choose. None: on a CPU a band where it is narrow, elsewhere
        dissection, which launches the fewest kernels.
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
        blocks = np.asarray(pattern.rows), np.asarray(pattern.columns)
        if couples_all:
            return cls(pattern, levels(rest, *blocks, leaf=len(rest)), couples_all)
        if order == "dissection":
            return cls(pattern, levels(rest, *blocks))
        band = Band.make(rest, *blocks)
        if order == "band" or (band.width <= WIDEST and jax.default_backend() == "cpu"):
            return cls(pattern, band)
        return cls(pattern, levels(rest, *blocks))
