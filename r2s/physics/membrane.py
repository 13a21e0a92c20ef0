"""Membrane: Green strain of a triangle, and the energy that a fabric stores in it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class OrthotropicMembrane(eqx.Module):
    """Orthotropic membrane with constant stiffness (St. Venant-Kirchhoff on Green strain).

    - `c11`: warp stiffness, [N/m].
    - `c12`: coupling of warp and weft, [N/m]; may be negative, with c12^2 < c11 c22.
    - `c22`: weft stiffness, [N/m].
    - `c33`: shear stiffness, [N/m], on the engineering shear strain 2 E12. The C33 of Wang et al.
      2011 and DiffSim acts on E12 alone: it is twice this one.
    """

    c11: Float[Array, "*batch"]
    c12: Float[Array, "*batch"]
    c22: Float[Array, "*batch"]
    c33: Float[Array, "*batch"]

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        e11, e22, shear = strain
        stretch = self.c11 * e11**2 + 2 * self.c12 * e11 * e22 + self.c22 * e22**2
        return (stretch + self.c33 * shear**2) / 2


def deformation_gradient(
    corners: Float[Array, "3 3"], inverse: Float[Array, "2 2"]
) -> Float[Array, "3 2"]:
    """F = [x1 - x0, x2 - x0] Dm^-1 [-]: the world images of the unit warp and weft vectors.

    `corners` are the triangle's positions [m], `inverse` the inverse of its rest edges [1/m].
    """
    edges = jnp.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
    return edges @ inverse


def green_strain(corners: Float[Array, "3 3"], inverse: Float[Array, "2 2"]) -> Float[Array, " 3"]:
    """Green strain (E11, E22, 2 E12) [-] of a triangle, E = (F^T F - 1) / 2."""
    deformation = deformation_gradient(corners, inverse)
    warp, weft = deformation[:, 0], deformation[:, 1]
    return jnp.stack([(warp @ warp - 1) / 2, (weft @ weft - 1) / 2, warp @ weft])
