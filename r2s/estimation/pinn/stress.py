"""Strain, stress and their divergence in a sheet, from the laws of `r2s.laws.membrane`.

The sheet has sides X (the pull) and Y. The law is in the axes of warp and weft, which are turned
by an `angle` from X. Stress is force per width [N/m]: no thickness enters.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import IsotropicSpace
from r2s.laws.membrane import OrthotropicMembrane
from r2s.laws.solid import lame

Gradient = Float[Array, "axis 2"]  # of displacement or position in X and Y, [-]
Voigt = Float[Array, " 3"]  # strain (E11, E22, 2 E12) [-], or stress (S11, S22, S12) [N/m]
Strain = Callable[[Gradient], Voigt]


def green(gradient: Gradient) -> Voigt:
    """Green strain [-] of a gradient of displacement; right for any rotation, and out of plane."""
    f = gradient + _unit(gradient)
    return jnp.stack([(f[:, 0] @ f[:, 0] - 1) / 2, (f[:, 1] @ f[:, 1] - 1) / 2, f[:, 0] @ f[:, 1]])


def small(gradient: Gradient) -> Voigt:
    """Small strain [-] of a gradient of displacement, with the engineering shear."""
    return jnp.stack([gradient[0, 0], gradient[1, 1], gradient[0, 1] + gradient[1, 0]])


def turned(strain: Voigt, angle: Float[Array, ""]) -> Voigt:
    """The strain [-] in axes that are turned by an angle [rad] from X towards Y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    e11, e22, shear = strain
    first = c**2 * e11 + s**2 * e22 + c * s * shear
    second = s**2 * e11 + c**2 * e22 - c * s * shear
    return jnp.stack([first, second, 2 * c * s * (e22 - e11) + (c**2 - s**2) * shear])


class TurnedMembrane(eqx.Module):
    """A membrane law whose warp is turned in the sheet, as in one that is cut on the bias.

    - `law`: any `MembraneLaw`. - `angle`: from the sheet's first side to the warp, [rad].
    """

    law: Any
    angle: Float[Array, "*batch"]

    def at(self, strain: Voigt) -> "TurnedMembrane":
        """The law that a time step uses which starts near this strain [-]."""
        return TurnedMembrane(self.law.at(turned(strain, self.angle)), self.angle)

    def energy_density(self, strain: Voigt) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain [-]."""
        return self.law.energy_density(turned(strain, self.angle))


def nominal_stress(
    fabric: Fabric,
    angle: Float[Array, ""],
    gradient: Gradient,
    rate: Gradient | None = None,
    strain: Strain = green,
) -> Gradient:
    """First Piola-Kirchhoff stress [N/m]: what work it does in a change of the gradient.

    With a `rate` [1/s] of the gradient that of Kelvin-Voigt damping too, `fabric.damping` times the
    stiffness times the rate of strain. Its first column is the traction on an edge across X, per
    width at rest. In Green strain it is F S; in small strain the symmetric stress.
    """
    energy = TurnedMembrane(fabric.membrane, angle).energy_density
    at, pull_back = jax.vjp(strain, gradient)
    if rate is not None:
        at = at + fabric.damping * jax.jvp(strain, (gradient,), (rate,))[1]
    return pull_back(jax.grad(energy)(at))[0]


def divergence(
    fabric: Fabric,
    angle: Float[Array, ""],
    gradient: Gradient,
    changes: Float[Array, "2 axis 2"],
    strain: Strain = green,
) -> Float[Array, " axis"]:
    """Divergence [N/m^2] of the nominal stress, from the derivatives [1/m] of the gradient in X, Y.

    Without damping, whose divergence would need third derivatives.
    """
    stress = lambda at: nominal_stress(fabric, angle, at, strain=strain)
    along = lambda change: jax.jvp(stress, (gradient,), (change,))[1]
    return along(changes[0])[:, 0] + along(changes[1])[:, 1]


class PlaneStrainFamily(IsotropicSpace):
    """Isotropic solids in plane strain, as the paper prints them: E times thickness, and nu.

    As `IsotropicSpace`, which is plane stress and right for a sheet.
    """

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        fabric = super().__call__(u)
        modulus, ratio = self.values(u)
        mu, lam = (jnp.asarray(value) for value in lame(modulus, ratio))
        law = OrthotropicMembrane(lam + 2 * mu, lam, lam + 2 * mu, mu)
        return eqx.tree_at(lambda f: f.membrane, fabric, law)

    def locate(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric's membrane lies, C11 and C22 averaged."""
        law = fabric.membrane
        ratio = law.c12 / ((law.c11 + law.c22) / 2)
        nu = ratio / (1 + ratio)
        modulus = (law.c11 + law.c22) / 2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        places = [r.place(v) for r, v in zip(self.ranges, (modulus, nu), strict=True)]
        return jnp.stack(places)


def _unit(like: Gradient) -> Gradient:
    return jnp.eye(like.shape[0], 2, dtype=like.dtype)
