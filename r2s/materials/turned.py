"""The membrane of a sheet that is cut at an angle to its yarns."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

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
