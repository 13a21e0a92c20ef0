"""Bending of a sheet as a thin plate: the energy in its curvature tensor.

A plate law sees the curvature (k11, k22, 2 k12) of a face, by warp and weft
(`r2s.geometry.patches`), as a membrane law sees its strain. It bends alike in all directions of a
regular mesh whose diagonals are parallel (`r2s.geometry.mesh.rectangle`), and twists as a plate
does, which hinges (`r2s.laws.bending`) do not.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.units import Scalar, isotropic_bending


class PlateLaw(eqx.Module):
    """What the cloth asks of a bending law that acts on faces; a law of one's own derives from it.

    (A class and not a protocol, since laws of hinges have the same two methods.)
    """

    @abstractmethod
    def at(self, curvature: Float[Array, " 3"]) -> "PlateLaw":
        """The law that a time step uses for a face which starts near this curvature [1/m]."""

    @abstractmethod
    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature (k11, k22, 2 k12) [1/m]."""


class PlateBending(PlateLaw):
    """The Kirchhoff plate, alike in all directions, of constant stiffness.

    - `stiffness`: moment per curvature and width of a plate that may not curve across, [N m].
    - `poissons_ratio`: how much it curves across when it may, [-]; -1 < nu < 1.
    """

    stiffness: Float[Array, "*batch"]
    poissons_ratio: Float[Array, "*batch"]

    @classmethod
    def make(cls, stiffness: Scalar, poissons_ratio: Scalar = 0.0) -> "PlateBending":
        """From a bending stiffness [N m] and Poisson's ratio [-]."""
        stiffness = jnp.asarray(stiffness, float)
        return cls(stiffness, jnp.broadcast_to(jnp.asarray(poissons_ratio, float), stiffness.shape))

    @classmethod
    def isotropic(
        cls, youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar
    ) -> "PlateBending":
        """Of a solid plate, from Young's modulus [Pa], Poisson's ratio [-] and thickness [m]."""
        return cls.make(
            isotropic_bending(youngs_modulus, poissons_ratio, thickness), poissons_ratio
        )

    def at(self, curvature: Float[Array, " 3"]) -> "PlateBending":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]: Timoshenko and Woinowsky-Krieger 1959,
        section 21.
        """
        warp, weft, twist = curvature
        nu = self.poissons_ratio
        pure = warp**2 + weft**2 + 2 * nu * warp * weft + (1 - nu) / 2 * twist**2
        return self.stiffness / 2 * pure


class OrthotropicPlate(PlateLaw):
    """A plate without Poisson effect, of constant stiffness along its yarns and across them.

    - `warp`, `bias`, `weft`: moment per curvature and width [N m] of a sheet that bends along 0, 45
      and 90 degrees from the warp. The bias must be above (warp + weft) / 4; (warp + weft) / 2
      makes the stiffness linear in the square of the direction's cosine.
    """

    warp: Float[Array, "*batch"]
    bias: Float[Array, "*batch"]
    weft: Float[Array, "*batch"]

    def at(self, curvature: Float[Array, " 3"]) -> "OrthotropicPlate":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        warp, weft, twist = curvature
        # at 45 degrees k11 = k22 = 2 k12 / 2
        of_twist = self.bias - (self.warp + self.weft) / 4
        return (self.warp * warp**2 + self.weft * weft**2 + of_twist * twist**2) / 2
