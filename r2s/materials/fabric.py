"""Fabric: what an estimator estimates. Presets with provenance are in `r2s.materials.presets`."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.arrays import is_traced
from r2s._util.units import GRAVITY
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import PlateBending

NUMBERS = {
    "density": "kg/m^2",
    "damping": "s",
    "friction": "-",
    "thickness": "m",
    "mass_damping": "1/s",
}
POSITIVE = "density", "thickness"
HEAVIEST = 20.0  # [kg/m^2]: above, an areal density was meant in g/m^2


class Fabric(eqx.Module):
    """A fabric. A leading batch axis on every field makes it a sweep, for `jax.vmap`.

    - `density`: areal density, [kg/m^2].
    - `membrane`, `bending`: the laws of its energies: any `MembraneLaw` [N/m], and
      any `PlateLaw` or `BendingLaw` [N m].
    - `damping`: stiffness-proportional (Kelvin-Voigt) damping time, [s]: the viscous stress is
      `damping` times the stiffness times the rate of strain.
    - `friction`: Coulomb coefficient against the table, [-].
    - `thickness`: distance from the table at which contact begins, [m].
    - `mass_damping`: mass-proportional damping rate, [1/s]: the force on a mass is minus
      `mass_damping` times its momentum. It also brakes rigid motion, as still air would.
    """

    density: Float[Array, "*batch"]
    membrane: Any
    bending: Any
    damping: Float[Array, "*batch"]
    friction: Float[Array, "*batch"]
    thickness: Float[Array, "*batch"]
    mass_damping: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        density: float,
        membrane: tuple[float, float, float, float],
        bending: float,
        damping: float = 0.01,
        friction: float = 0.5,
        thickness: float = 1e-3,
        mass_damping: float = 0.0,
    ) -> "Fabric":
        """A fabric from numbers: areal density [kg/m^2], (C11, C12, C22, C33) [N/m], bending
        stiffness [N m], damping time [s], friction [-], thickness [m], mass damping [1/s].

        Raises `ValueError` when one is out of its physical range.

        >>> fabric = Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5)
        >>> float(fabric.membrane.c12)
        60.0
        """
        stiffnesses = (jnp.asarray(number, float) for number in membrane)
        others = (damping, friction, thickness, mass_damping)
        fabric = cls(
            jnp.asarray(density, float),
            OrthotropicMembrane(*stiffnesses),
            PlateBending.make(bending),
            *(jnp.asarray(number, float) for number in others),
        )
        check_fabric(fabric)
        c11, c12, c22, _ = membrane
        if not c12**2 < c11 * c22:
            raise ValueError(
                f"C12^2 must be less than C11 C22, or the sheet has a negative stiffness: "
                f"C12 = {c12} N/m, C11 C22 = {c11 * c22} (N/m)^2"
            )
        return fabric


def check_fabric(fabric: Any, may_lack: bool = False) -> None:
    """Raise `ValueError` for a fabric, or a member of a batch, with a number out of its range.

    A traced fabric passes, and so does what is no `Fabric`. `may_lack`: NaN passes, as unknown.
    """
    if not isinstance(fabric, Fabric) or is_traced(fabric):
        return
    numbers = {name: (getattr(fabric, name), unit) for name, unit in NUMBERS.items()}
    if isinstance(fabric.membrane, OrthotropicMembrane):
        law = fabric.membrane
        numbers |= {f"membrane.{n}": (getattr(law, n), "N/m") for n in ("c11", "c22", "c33")}
    if isinstance(fabric.bending, PlateBending):
        numbers["bending.stiffness"] = fabric.bending.stiffness, "N m"
    for name, (values, unit) in numbers.items():
        least = float(np.min(np.asarray(values)))
        must_be_positive = name in POSITIVE or name.startswith("membrane.")
        if may_lack and math.isnan(least):
            continue
        if not least >= 0 or (must_be_positive and least == 0):
            word = "positive" if must_be_positive else "not negative"
            raise ValueError(f"fabric: {name} must be {word} [{unit}], found {least}")
    check_density(float(np.max(np.asarray(fabric.density))))


def check_density(density: float) -> None:
    """Raise `ValueError` for an areal density [kg/m^2] that must have been meant in g/m^2."""
    if density > HEAVIEST:
        grams = f"{density / 1e3:g} if that is in g/m^2"
        raise ValueError(f"density must be in kg/m^2, found {density:g}: {grams}")


def constant_laws(fabric: Fabric) -> tuple[OrthotropicMembrane, PlateBending]:
    """The laws of a fabric whose stiffness is constant; raises `TypeError` for another one."""
    membrane, bending = fabric.membrane, fabric.bending
    if not isinstance(membrane, OrthotropicMembrane) or not isinstance(bending, PlateBending):
        raise TypeError(
            "this needs a fabric of constant stiffness (OrthotropicMembrane, PlateBending), got "
            f"{type(membrane).__name__} and {type(bending).__name__}"
        )
    return membrane, bending


DIRECTIONS = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)  # of bending, from the warp [rad]


def bending_length(fabric: Fabric) -> Float[Array, ""]:
    """The gravito-bending length [m], at which a fabric bends under its own weight.

    It is (bending / (density g))^(1/3), with the mean stiffness over four directions: Peirce's
    bending length (Journal of the Textile Institute 21, 1930). A strip of that length, held at one
    end, sags by an eighth of it. Longer cells cannot take the folds of a sheet, which then moves
    differently from a fine one (`docs/guide/simulate.md` says by how much).

    >>> from r2s.materials import presets
    >>> round(float(1e3 * bending_length(presets.grey_interlock())), 1)  # [mm]
    14.3
    """
    along = jnp.stack([fabric.bending.stiffness_along(angle) for angle in DIRECTIONS])
    return (jnp.mean(along) / (fabric.density * GRAVITY)) ** (1 / 3)
