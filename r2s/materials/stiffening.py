"""A sheet that stiffens as it stretches and softens as it bends, with an energy in closed form.

Knits and wovens stiffen once their crimp is pulled out (Wang, O'Brien and Ramamoorthi 2011 measured
tables of it), and bend more easily once the friction between their yarns is overcome. The curves
here are assumed. They derive from an energy, so that the motion of such a sheet converges.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import PlateBending, PlateLaw

HALF = (2 ** (2 / 3) - 1) ** 0.5  # of the knee, where half of the growth is reached


class StiffeningMembrane(eqx.Module):
    """An orthotropic membrane whose yarns stiffen as they stretch, up to a limit.

    Along a yarn at a Green strain E > 0 the tangent is C (1 + (ratio - 1) (1 - (1 + u^2)^-3/2)),
    u = E / knee. Against shear, where yarns turn and do not stretch, it stays as it is.

    - `small`: the membrane at small strain.
    - `ratio`: of the tangent far stretched to that at rest, [-].
    - `knee`, `knee_weft`: of warp and weft the Green strain of u = 1, where 65 % of the growth is
      reached, [-].
    """

    small: OrthotropicMembrane
    ratio: Float[Array, "*batch"]
    knee: Float[Array, "*batch"]
    knee_weft: Float[Array, "*batch"]
    units: ClassVar[dict[str, str]] = {"ratio": "-", "knee": "-", "knee_weft": "-"}

    @classmethod
    def make(
        cls,
        small: OrthotropicMembrane,
        ratio: float,
        stretch: float,
        stretch_weft: float | None = None,
    ) -> "StiffeningMembrane":
        """From the ratio, and the stretch (above 1) at which half of the growth is reached, of the
        warp and of the weft (None: the same).

        Raises `ValueError` for a ratio below 1, or a stretch that is not above 1.
        """
        stretches = (stretch, stretch if stretch_weft is None else stretch_weft)
        if not (ratio >= 1 and min(stretches) > 1):
            raise ValueError(f"needs a ratio >= 1 and stretches > 1, got {ratio} and {stretches}")
        numbers = (ratio, *((stretch**2 - 1) / 2 / HALF for stretch in stretches))
        more, *knees = (
            jnp.broadcast_to(jnp.asarray(n, float), jnp.shape(small.c11)) for n in numbers
        )
        return cls(small, more, *knees)

    def at(self, strain: Float[Array, " 3"]) -> "StiffeningMembrane":
        """Itself: it has an energy."""
        return self

    @property
    def stiffest(self) -> OrthotropicMembrane:
        """A membrane that is nowhere softer."""
        small, more = self.small, self.ratio
        return OrthotropicMembrane(more * small.c11, small.c12, more * small.c22, small.c33)

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-]."""
        e11, e22, _ = strain
        small = self.small
        more = small.c11 * _grown(e11, self.knee) + small.c22 * _grown(e22, self.knee_weft)
        return small.energy_density(strain) + (self.ratio - 1) * more


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
    units: ClassVar[dict[str, str]] = {"loss": "-", "knee": "1/m"}

    def energy_density(self, curvature: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature (k11, k22, 2 k12) [1/m]."""
        full = self.small.energy_density(curvature)
        unit = self.small.stiffness * self.knee**2 / 2
        return full - self.loss * (full - unit * jnp.log1p(full / unit))


def _grown(strain: Float[Array, ""], knee: Float[Array, ""]) -> Float[Array, ""]:
    """Energy over stiffness of what a ratio of 2 adds to a yarn, [-]."""
    square = (jnp.maximum(strain, 0) / knee) ** 2
    root = jnp.sqrt(1 + square)
    return knee**2 * (square / 2 - square / (1 + root))
