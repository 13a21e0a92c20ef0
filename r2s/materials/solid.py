"""Laws of solids: the stress from the deformation gradient F, in 3-D and in 2-D (plane strain).

A law (`SolidLaw`) is a pytree of parameters with methods of one particle.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.arrays import is_traced
from r2s._util.units import Scalar

Matrix = Float[Array, "axis axis"]

POLAR_ITERATIONS = 6  # of Newton in 3-D: to rounding for principal stretches up to a ratio of 1e4


@runtime_checkable
class SolidLaw(Protocol):
    """The methods that the material point method calls."""

    def energy_density(self, deformation: Matrix) -> Float[Array, ""]:
        """Energy per rest volume [J/m^3] at a deformation gradient [-]."""
        ...

    def kirchhoff(self, deformation: Matrix) -> Matrix:
        """Kirchhoff stress dE/dF F^T [Pa]."""
        ...

    def viscous(self, rate: Matrix) -> Matrix:
        """Viscous stress over the damping time [Pa/s] at a velocity gradient [1/s]."""
        ...

    def modulus(self, dimension: int) -> Float[Array, ""]:
        """The largest eigenvalue of the elasticity tensor at rest [Pa], which limits the step."""
        ...


class _Isotropic(eqx.Module):
    """An isotropic law with Lame's constants `mu` and `lam` [Pa]."""

    mu: Float[Array, "*batch"]
    lam: Float[Array, "*batch"]

    @classmethod
    def make(cls, young: Scalar, poisson: Scalar):
        """A law from Young's modulus [Pa] and Poisson's ratio [-].

        Raises `ValueError` when one is out of its physical range, unless it is traced.
        """
        if not is_traced(young, poisson) and not (float(young) > 0 and -1 < float(poisson) < 0.5):
            raise ValueError(
                "Young's modulus must be positive [Pa] and Poisson's ratio between -1 and 0.5, "
                f"got {young} and {poisson}"
            )
        mu = young / (2 * (1 + poisson))
        lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        return cls(jnp.asarray(mu, float), jnp.asarray(lam, float))

    def modulus(self, dimension: int) -> Float[Array, ""]:
        """The largest eigenvalue of the elasticity tensor at rest [Pa], that of dilation."""
        return jnp.maximum(dimension * self.lam, 0) + 2 * self.mu

    def viscous(self, rate: Matrix) -> Matrix:
        """Viscous stress over the damping time [Pa/s] at a velocity gradient [1/s]."""
        symmetric = (rate + rate.T) / 2
        return 2 * self.mu * symmetric + self.lam * jnp.trace(rate) * _identity(rate)


class FixedCorotated(_Isotropic):
    """mu |F - R|^2 + lambda / 2 (J - 1)^2, with R the rotation of F (Stomakhin et al. 2012)."""

    def energy_density(self, deformation: Matrix) -> Float[Array, ""]:
        """Energy per rest volume [J/m^3] at a deformation gradient [-]."""
        stretch = deformation - rotation_of(deformation)
        volume = determinant(deformation)
        return self.mu * jnp.sum(stretch**2) + self.lam / 2 * (volume - 1) ** 2

    def kirchhoff(self, deformation: Matrix) -> Matrix:
        """Kirchhoff stress [Pa]: 2 mu (F - R) F^T + lambda (J - 1) J."""
        volume = determinant(deformation)
        shear = product(deformation - rotation_of(deformation), deformation.T)
        return 2 * self.mu * shear + self.lam * (volume - 1) * volume * _identity(deformation)


class NeoHookean(_Isotropic):
    """mu / 2 (|F|^2 - d - 2 log J) + lambda / 2 (log J)^2; NaN when turned inside out."""

    def energy_density(self, deformation: Matrix) -> Float[Array, ""]:
        """Energy per rest volume [J/m^3] at a deformation gradient [-]."""
        log = jnp.log(determinant(deformation))
        shear = jnp.sum(deformation**2) - deformation.shape[0] - 2 * log
        return self.mu / 2 * shear + self.lam / 2 * log**2

    def kirchhoff(self, deformation: Matrix) -> Matrix:
        """Kirchhoff stress [Pa]: mu F F^T + (lambda log J - mu)."""
        pressure = self.lam * jnp.log(determinant(deformation)) - self.mu
        shear = product(deformation, deformation.T)
        return self.mu * shear + pressure * _identity(deformation)


class LinearSolid(_Isotropic):
    """mu e : e + lambda / 2 (tr e)^2 of e = (F + F^T) / 2 - 1: for small strains and rotations."""

    def energy_density(self, deformation: Matrix) -> Float[Array, ""]:
        """Energy per rest volume [J/m^3] at a deformation gradient [-]."""
        strain = (deformation + deformation.T) / 2 - _identity(deformation)
        return self.mu * jnp.sum(strain**2) + self.lam / 2 * jnp.trace(strain) ** 2

    def kirchhoff(self, deformation: Matrix) -> Matrix:
        """Kirchhoff stress [Pa]: (2 mu e + lambda tr e) F^T."""
        return product(self.viscous(deformation - _identity(deformation)), deformation.T)


class Solid(eqx.Module):
    """The material of a solid body, as `r2s.Fabric` is that of a sheet.

    - `law`: any `SolidLaw`.
    - `density`: mass per volume at rest, [kg/m^3]; in 2-D of a body of 1 m depth.
    - `damping`: stiffness-proportional (Kelvin-Voigt) damping time, [s].
    - `friction`: Coulomb coefficient against the table, [-].
    - `mass_damping`: mass-proportional damping rate, [1/s].
    """

    law: Any
    density: Float[Array, "*batch"]
    damping: Float[Array, "*batch"]
    friction: Float[Array, "*batch"]
    mass_damping: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        law: SolidLaw,
        density: Scalar,
        damping: Scalar = 0.0,
        friction: Scalar = 0.5,
        mass_damping: Scalar = 0.0,
    ) -> "Solid":
        """A solid from its fields, as numbers or arrays.

        Raises `ValueError` when one is out of its physical range, unless it is traced.
        """
        values = density, damping, friction, mass_damping
        if not is_traced(values) and not (float(density) > 0 and min(map(float, values[1:])) >= 0):
            raise ValueError(
                "density [kg/m^3] must be positive; damping [s], friction [-] and mass damping "
                f"[1/s] must not be negative, got {values}"
            )
        return cls(law, *(jnp.asarray(value, float) for value in values))


def plate_solid(c11: Scalar, c12: Scalar, bending: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Young's modulus [Pa], Poisson's ratio [-] and thickness [m] of a plate of given stiffness.

    nu = C12 / C11 and h^2 = 12 B / C11, from C11 and C12 [N/m] and the bending stiffness B [N m] of
    an isotropic sheet.

    >>> [round(x, 3) for x in plate_solid(109.89010989, 32.967032967, 9.1575091575e-6)]
    [100000.0, 0.3, 0.001]
    """
    poisson = c12 / c11
    thickness = (12 * bending / c11) ** 0.5
    return c11 * (1 - poisson**2) / thickness, poisson, thickness


def determinant(matrix: Matrix) -> Float[Array, ""]:
    """The determinant of a 2 x 2 or 3 x 3 matrix."""
    if matrix.shape[0] == 2:
        return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    return jnp.sum(matrix[0] * jnp.cross(matrix[1], matrix[2]))


def product(left: Matrix, right: Matrix) -> Matrix:
    """The matrix product in full precision, to which `@` may not keep on a GPU."""
    return jnp.sum(left[:, :, None] * right[None], axis=1)


@jax.custom_jvp
def rotation_of(matrix: Matrix) -> Matrix:
    """The rotation R of the polar decomposition F = R S; in 3-D a reflection when det F < 0.

    It has a closed form in 2-D; in 3-D it comes from Newton's method with scaling (Higham 1986).
    """
    if matrix.shape[0] == 2:
        cosine, sine = matrix[0, 0] + matrix[1, 1], matrix[1, 0] - matrix[0, 1]
        length = jnp.sqrt(cosine**2 + sine**2)
        c = jnp.where(length > 0, cosine / length, 1)
        s = jnp.where(length > 0, sine / length, 0)
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    rotation = matrix
    for _ in range(POLAR_ITERATIONS):
        rotation = _newton_polar(rotation)
    return rotation


def _newton_polar(matrix: Matrix) -> Matrix:
    cofactors = _cofactors(matrix)
    inverse = cofactors / jnp.sum(matrix[0] * cofactors[0])  # transposed
    scale = (jnp.sum(inverse**2) / jnp.sum(matrix**2)) ** 0.25
    return (scale * matrix + inverse / scale) / 2


@rotation_of.defjvp
def _rotation_of_jvp(primals, tangents):
    """R' = R W, with W skew and W S + S W = R^T F' - F'^T R, also where principal stretches meet.

    For the axial vector w of W the left side is (tr S - S) w in 3-D and tr S w in 2-D.
    """
    (matrix,), (change,) = primals, tangents
    rotation = rotation_of(matrix)
    turned = product(rotation.T, change)
    skew, stretch = turned - turned.T, product(rotation.T, matrix)
    if matrix.shape[0] == 2:
        spin = skew / jnp.trace(stretch)
        return rotation, product(rotation, spin)
    axial = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    x, y, z = _solve(jnp.trace(stretch) * _identity(stretch) - stretch, axial)
    zero = jnp.zeros_like(x)
    spin = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return rotation, product(rotation, spin)


def _solve(matrix: Matrix, right: Float[Array, " axis"]) -> Float[Array, " axis"]:
    """The solution of a symmetric 3 x 3 system, by cofactors."""
    cofactors = _cofactors(matrix)
    return jnp.sum(cofactors * right[:, None], axis=0) / jnp.sum(matrix[0] * cofactors[0])


def _cofactors(matrix: Matrix) -> Matrix:
    a, b, c = matrix
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])


def _identity(like: Matrix) -> Matrix:
    return jnp.eye(like.shape[0], dtype=like.dtype)
