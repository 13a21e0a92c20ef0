"""Bending of a sheet as a thin plate: the energy in its curvature tensor.

A plate law sees the curvature (k11, k22, 2 k12) of an element, by warp and weft
(`r2s.mesh.plate_elements`), as a membrane law sees a strain. Its stiffness does not depend on the
direction of the mesh, and it twists as a plate does, unlike hinges (`r2s.materials.bending`).
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.units import Scalar, isotropic_bending
from r2s.materials.bending import BendingLaw
from r2s.mesh.mesh import Mesh
from r2s.mesh.plate_elements import PlateElements


class PlateLaw(BendingLaw):
    """A bending law of faces or vertices: of their curvature tensor.

    The weft must be an axis of symmetry, so that small twists do not bend the sheet: a grid has its
    curvature and its twist at different places.
    """

    element: ClassVar[str] = "plate"
    bend: ClassVar[str] = "plate_bends"

    def at(self, curvature: Float[Array, " 3"]) -> "PlateLaw":
        """The law of a time step near a curvature [1/m]: itself, as it has an energy."""
        return self

    @abstractmethod
    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature (k11, k22, 2 k12) [1/m]."""

    def elements(self, mesh: Mesh) -> PlateElements:
        """The plate elements of the mesh."""
        return mesh.plate

    def on_elements(self, mesh: Mesh, bends: Float[Array, " bend"]) -> Any:
        """The law of every element, by its curvature."""
        return jax.vmap(self.at)(self.curvatures(mesh, bends))

    def stiffness_along(self, angle: float) -> Float[Array, ""]:
        """Stiffness [N m] of the flat plate against a cylinder at an angle [rad] to the warp."""
        flat, (c, s) = jnp.zeros(3, float), (math.cos(angle), math.sin(angle))
        matrix = jax.hessian(self.at(flat).energy_density)(flat)
        cylinder = jnp.asarray([c**2, s**2, math.sin(2 * angle)], float)
        return cylinder @ matrix @ cylinder


class PlateBending(PlateLaw):
    """The isotropic Kirchhoff plate, of constant stiffness.

    - `stiffness`: moment per curvature and width of a plate that may not curve across, [N m].
    - `poissons_ratio`: how much it curves across when it may, [-]; -1 < nu < 1.
    """

    stiffness: Float[Array, "*batch"]
    poissons_ratio: Float[Array, "*batch"]
    units: ClassVar[dict[str, str]] = {"poissons_ratio": "-"}

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
        stiffness = isotropic_bending(youngs_modulus, poissons_ratio, thickness)
        return cls.make(stiffness, poissons_ratio)

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

    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        warp, weft, twist = curvature
        # at 45 degrees k11 = k22 = 2 k12 / 2
        of_twist = self.bias - (self.warp + self.weft) / 4
        return (self.warp * warp**2 + self.weft * weft**2 + of_twist * twist**2) / 2
