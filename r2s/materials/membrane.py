"""Membrane laws: the energy that a fabric stores in the Green strain of a triangle.

A law is a pytree of parameters with two methods: `energy_density` of a strain, and `at`, which
gives the law that a time step uses. A law with an energy returns itself; one whose stiffness
depends on the strain (`r2s.materials.tables`) returns the law of its stiffness there.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.units import Scalar, isotropic_membrane

COLLAPSED = 1e-6  # squared stretch below which a spring has no direction, nor force


@runtime_checkable
class MembraneLaw(Protocol):
    """The methods of a membrane law that solvers call."""

    def at(self, strain: Float[Array, " 3"]) -> "MembraneLaw":
        """The law that a time step uses which starts near this strain (E11, E22, 2 E12) [-]."""
        ...

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        ...


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

    @classmethod
    def isotropic(
        cls, youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar
    ) -> "OrthotropicMembrane":
        """From Young's modulus [Pa], Poisson's ratio [-] and thickness [m], in plane stress."""
        law = isotropic_membrane(youngs_modulus, poissons_ratio, thickness)
        return cls(*(jnp.asarray(c, float) for c in law))

    def at(self, strain: Float[Array, " 3"]) -> "OrthotropicMembrane":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        e11, e22, shear = strain
        stretch = self.c11 * e11**2 + 2 * self.c12 * e11 * e22 + self.c22 * e22**2
        return (stretch + self.c33 * shear**2) / 2


class SpringMembrane(eqx.Module):
    """Springs along warp, weft and both biases: the mass-spring model, as energy of a strain.

    On a grid of squares in triangles its energy is that of springs on the edges and on both
    diagonals of every cell (for the diagonal that is no edge: as long as the cell is bent little).
    Small strains see an orthotropic membrane with C11 = warp + shear / 2, C22 = weft + shear / 2
    and C12 = C33 = shear / 2: coupling and shear of springs are the same (Cauchy).

    - `warp`, `weft`: of the structural springs, force per width and stretch, [N/m].
    - `shear`: likewise of the springs at +45 and -45 degrees, [N/m].
    """

    warp: Float[Array, "*batch"]
    weft: Float[Array, "*batch"]
    shear: Float[Array, "*batch"]

    def at(self, strain: Float[Array, " 3"]) -> "SpringMembrane":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        e11, e22, shear = strain
        mean, half = (e11 + e22) / 2, shear / 2

        def extension(along):
            return jnp.sqrt(jnp.maximum(1 + 2 * along, COLLAPSED)) - 1

        structural = self.warp * extension(e11) ** 2 + self.weft * extension(e22) ** 2
        biases = extension(mean + half) ** 2 + extension(mean - half) ** 2
        return (structural + self.shear * biases) / 2


def stress_and_tangent(
    law: MembraneLaw, strain: Float[Array, " 3"]
) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """First and second derivative [N/m] of a law's energy density in a strain."""

    def stresses(strain):
        stress = jax.grad(law.energy_density)(strain)
        return stress, stress

    tangent, stress = jax.jacfwd(stresses, has_aux=True)(strain)
    return stress, tangent


Voigt = Float[Array, " 3"]  # strain (E11, E22, 2 E12) [-]


def turned(strain: Voigt, angle: Float[Array, ""]) -> Voigt:
    """The strain [-] in axes that are turned by an angle [rad] from X towards Y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    e11, e22, shear = strain
    first = c**2 * e11 + s**2 * e22 + c * s * shear
    second = s**2 * e11 + c**2 * e22 - c * s * shear
    return jnp.stack([first, second, 2 * c * s * (e22 - e11) + (c**2 - s**2) * shear])


class TurnedMembrane(eqx.Module):
    """A membrane law whose warp is turned in the sheet, for a sheet that is cut on the bias.

    - `law`: any `MembraneLaw`.
    - `angle`: from the sheet's first side to the warp, [rad].
    """

    law: Any
    angle: Float[Array, "*batch"]

    def at(self, strain: Voigt) -> "TurnedMembrane":
        """The law that a time step uses which starts near this strain [-]."""
        return TurnedMembrane(self.law.at(turned(strain, self.angle)), self.angle)

    def energy_density(self, strain: Voigt) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain [-]."""
        return self.law.energy_density(turned(strain, self.angle))
