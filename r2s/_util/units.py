"""Constants, conversions, checks of quantities. All is SI: metres, kilograms, seconds; z is up.

Membrane stiffness is a force per width, [N/m]; bending stiffness a moment per curvature and width,
[N m]; areal density [kg/m^2]. Shear strain is the engineering one, so that C33 of an isotropic
sheet is its shear modulus times its thickness.
"""

import math

import numpy as np
from jaxtyping import Array, Float

GRAVITY = 9.81  # [m/s^2], downwards
AIR_DENSITY = 1.2  # [kg/m^3], at 20 degrees Celsius and 101 kPa

Scalar = Float[Array, ""] | float


def positive(unit: str, **numbers: float | int) -> None:
    """Raise a `ValueError` that names a number and its unit unless it is positive and finite."""
    for name, value in numbers.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive [{unit}], found {value}")


def not_negative(unit: str, **numbers: float | int) -> None:
    """As `positive`, but zero is allowed."""
    for name, value in numbers.items():
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must not be negative [{unit}], found {value}")


def millimetres(length: float | np.floating) -> str:
    """A length [m] for people, in three digits."""
    return f"{1e3 * length:.3g} mm" if math.isfinite(length) else "unknown"


def isotropic_membrane(
    youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """C11, C12, C22, C33 [N/m] of an isotropic sheet in plane stress.

    From Young's modulus [Pa], Poisson's ratio [-] and thickness [m].

    >>> [round(c, 2) for c in isotropic_membrane(1e5, 0.3, 1e-3)]
    [109.89, 32.97, 109.89, 38.46]
    """
    c11 = youngs_modulus * thickness / (1 - poissons_ratio**2)
    c33 = youngs_modulus * thickness / (2 * (1 + poissons_ratio))
    return c11, poissons_ratio * c11, c11, c33


def isotropic_bending(youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar) -> Scalar:
    """Bending stiffness E h^3 / (12 (1 - nu^2)) [N m] of a solid isotropic plate (Kirchhoff).

    From Young's modulus [Pa], Poisson's ratio [-] and thickness [m]. A woven or knitted fabric is
    far softer in bending than a plate of its membrane stiffness: measure both.

    >>> round(isotropic_bending(1e5, 0.3, 1e-3) * 1e6, 3)  # [1e-6 N m]
    9.158
    """
    return youngs_modulus * thickness**3 / (12 * (1 - poissons_ratio**2))
