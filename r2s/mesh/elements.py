"""What a moved sheet shows at its elements: strains, normals, masses."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.mesh.mesh import Mesh

Positions = Float[Array, "vertex 3"]


def strains(mesh: Mesh, x: Positions) -> Float[Array, "sample 3"]:
    """Green strain (E11, E22, 2 E12) [-] of every sample, at positions [m]."""
    return mesh.samples.strains(x).reshape(-1, 3)


def area_normals(mesh: Mesh, x: Positions) -> Float[Array, "element 3"]:
    """Normals of the elements that strains are taken in, as long as their areas, [m^2]."""
    corners = x[mesh.samples.corners]
    if corners.shape[1] == 4:  # across the diagonals of a quadrilateral
        return jnp.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) / 2
    return jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def vertex_masses(mesh: Mesh, density: Float[Array, ""]) -> Float[Array, " vertex"]:
    """Lumped mass [kg] of every vertex of a sheet, from its areal density [kg/m^2]."""
    return density * mesh.vertex_area
