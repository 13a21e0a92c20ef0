"""Compression and shear between the layers of a sheet in contact, without tension.

Each triangle has a transverse direction d, at rest its unit normal n, which the grid's velocity
gradient carries along. Where layers press on each other, d shortens and tilts. After Jiang, Gast
and Teran, "Anisotropic elastoplasticity for cloth, knit and hair frictional contact" (ACM
Transactions on Graphics 36(4), 2017), with

    energy per area = K / 3 max(c - r, 0)^3 + G / 2 |s|^2,   r = d . n,   s = d - r n

and their return mapping: a separated layer returns to r = 1 and s = 0, a pressed one slides when
the shear stress exceeds friction times the pressure. Through the grid, layers interact from a
distance of three spacings; they press only from a shortening to c < 1 on, so that they come closer.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, " 3"]

SMOOTHING = 1e-6  # [-]: added to the tilt's norm, which is then differentiable at no tilt


class Transverse(eqx.Module):
    """The stiffnesses of contact between layers.

    - `compression`, `shear`: K and G, force per width, [N/m].
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

    def return_mapping(
        self, corners: Float[Array, "3 3"], direction: Vector, friction: Float[Array, ""]
    ) -> Vector:
        """The transverse direction [-] that friction and separation leave."""
        normal = unit_normal(corners)
        along = direction @ normal
        tilt = direction - along * normal
        along = jnp.minimum(along, 1)
        limit = friction * self.compression * jnp.maximum(self.onset - along, 0) ** 2 / self.shear
        size = jnp.sqrt(tilt @ tilt + SMOOTHING**2)
        return along * normal + jnp.minimum(limit / size, 1) * tilt

    def stress(
        self, corners: Float[Array, "3 3"], direction: Vector
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Forces on the corners per rest area [Pa], and the Kirchhoff stress times the thickness
        [N/m], which goes to the grid.

        Together they exert no torque, since rotations do not change the energy.
        """
        in_corners, in_direction = jax.grad(self.energy, argnums=(0, 1))(corners, direction)
        return -in_corners, in_direction[:, None] * direction[None]

    def frequency(self, density: Float[Array, ""], spacing: float) -> Float[Array, ""]:
        """A bound on the square of the highest frequency [1/s^2] on a grid, for d >= 1/2.

        `density` is areal [kg/m^2], `spacing` that of the grid [m]; see `block.stable_step`.
        """
        return 4 * jnp.maximum(self.compression, self.shear) / (density * spacing**2)


def unit_normal(corners: Float[Array, "3 3"]) -> Vector:
    """The unit normal of a triangle [-]."""
    normal = jnp.cross(corners[1] - corners[0], corners[2] - corners[0])
    return normal / jnp.sqrt(normal @ normal)
