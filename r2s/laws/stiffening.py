"""A sheet that stiffens as it stretches and softens as it bends, with an energy in closed form.

Knits and wovens stiffen once their crimp is pulled out (Wang, O'Brien and Ramamoorthi 2011 measured
tables of it), and bend more easily once the friction between their yarns is overcome. The curves
here are assumed; that they have one energy makes such a sheet a converged truth to judge others by.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.laws.membrane import OrthotropicMembrane
from r2s.laws.plate import PlateBending, PlateLaw


class StiffeningMembrane(eqx.Module):
    """An orthotropic membrane whose tangent stiffness along its yarns grows as they stretch.

    - `small`: the membrane at small strain.
    - `growth`: g of the tangent C (1 + 3 g E^2) along a yarn at a Green strain E > 0 [-]. Against
      shear, where yarns turn and do not stretch, it stays as it is.
    """

    small: OrthotropicMembrane
    growth: Float[Array, "*batch"]

    @classmethod
    def make(cls, small: OrthotropicMembrane, ratio: float, stretch: float) -> "StiffeningMembrane":
        """From the tangent stiffness along a yarn at a `stretch` (above 1) over that at rest.

        Raises `ValueError` for a sheet that would soften, or a stretch that is none.
        """
        if not (ratio >= 1 and stretch > 1):
            raise ValueError(f"a ratio of 1 or more and a stretch above 1, got {ratio}, {stretch}")
        strain = (stretch**2 - 1) / 2
        growth = jnp.asarray((ratio - 1) / (3 * strain**2), float)
        return cls(small, jnp.broadcast_to(growth, jnp.shape(small.c11)))

    def at(self, strain: Float[Array, " 3"]) -> "StiffeningMembrane":
        """Itself: its energy says it all."""
        return self

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        e11, e22, _ = strain
        small = self.small
        warp, weft = jnp.maximum(e11, 0) ** 4, jnp.maximum(e22, 0) ** 4
        more = small.c11 * warp + small.c22 * weft
        return small.energy_density(strain) + self.growth / 4 * more


class SofteningPlate(PlateLaw):
    """A Kirchhoff plate whose moment per curvature falls as it bends.

    With k the root of twice the energy of a plate of unit stiffness (of a cylinder its curvature),
    the moment is B k (1 - loss k^2 / (k^2 + knee^2)).

    - `small`: the plate at small curvature, of stiffness B.
    - `loss`: share of B that is lost at large curvatures, [-]; below 8/9, so that the moment grows.
    - `knee`: curvature at which half of it is lost, [1/m].
    """

    small: PlateBending
    loss: Float[Array, "*batch"]
    knee: Float[Array, "*batch"]

    def at(self, curvature: Float[Array, " 3"]) -> "SofteningPlate":
        """Itself: its energy says it all."""
        return self

    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature (k11, k22, 2 k12) [1/m]."""
        full = self.small.energy_density(curvature)
        unit = self.small.stiffness * self.knee**2 / 2
        return full - self.loss * (full - unit * jnp.log1p(full / unit))
