"""What a sheet does across its layers: compression and shear between them, and no tension.

Each triangle has a transverse direction d, at rest its unit normal n, which the grid's velocity
gradient carries along. Where layers press on each other, it shortens and tilts. After Jiang, Gast
and Teran, "Anisotropic elastoplasticity for cloth, knit and hair frictional contact" (ACM
Transactions on Graphics 36(4), 2017), with

    energy per area = K / 3 max(c - r, 0)^3 + G / 2 |s|^2,   r = d . n,   s = d - r n

and their return mapping: a separated layer forgets (r = 1, s = 0), a pressed one slides when the
shear stress exceeds friction times the pressure. The grid makes layers feel each other when they
are three spacings apart; so that they come closer, they press only from a shortening to c < 1 on.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, " 3"]

SHEARED = 1e-6  # [-]: a tilt below which its direction is blurred


class Transverse(eqx.Module):
    """- `compression`, `shear`: K and G, force per width, [N/m].
    - `onset`: c, [-].
    """

    compression: Float[Array, ""]
    shear: Float[Array, ""]
    onset: Float[Array, ""]

    def energy(self, corners: Float[Array, "3 3"], direction: Vector) -> Float[Array, ""]:
        """Energy per area [J/m^2] of a triangle [m] and its transverse direction [-]."""
        along = direction @ unit_normal(corners)
        tilt = direction @ direction - along**2
        return (
            self.compression / 3 * jnp.maximum(self.onset - along, 0) ** 3 + self.shear / 2 * tilt
        )

    def settled(
        self, corners: Float[Array, "3 3"], direction: Vector, friction: Float[Array, ""]
    ) -> Vector:
        """The direction [-] after the return mapping."""
        normal = unit_normal(corners)
        along = direction @ normal
        tilt = direction - along * normal
        along = jnp.minimum(along, 1)
        limit = friction * self.compression * jnp.maximum(self.onset - along, 0) ** 2 / self.shear
        size = jnp.sqrt(tilt @ tilt + SHEARED**2)
        return along * normal + jnp.minimum(limit / size, 1) * tilt

    def stress(
        self, corners: Float[Array, "3 3"], direction: Vector
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Forces on the corners per rest area [Pa], and the Kirchhoff stress times the thickness
        [N/m], to which the grid answers.

        Together they exert no torque, since rotations leave the energy as it is.
        """
        slope, pull = jax.grad(self.energy, argnums=(0, 1))(corners, direction)
        return -slope, pull[:, None] * direction[None]

    def frequency(self, density: Float[Array, ""], spacing: float) -> Float[Array, ""]:
        """A bound on the square of its highest frequency [1/s^2] on a grid, half crushed at most.

        From the areal density [kg/m^2] and the grid's spacing [m]; as of a solid block.
        """
        return 4 * jnp.maximum(self.compression, self.shear) / (density * spacing**2)


def unit_normal(corners: Float[Array, "3 3"]) -> Vector:
    """Of a triangle [-]."""
    normal = jnp.cross(corners[1] - corners[0], corners[2] - corners[0])
    return normal / jnp.sqrt(normal @ normal)
