"""Parameter spaces: which numbers of a fabric an estimator may move, and within which bounds.

A space maps a point of the unit cube to a fabric, so that one flat vector serves gradients,
sensitivities, multi-start and sampling.
"""

import abc
import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric, constant_laws
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import PlateBending


@dataclass(frozen=True)
class Range:
    """The bounds of one parameter: on a logarithmic scale when `log`."""

    name: str
    unit: str
    low: float
    high: float
    log: bool = True

    def __post_init__(self):
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError(
                f"{self.name}: bounds must increase, and be positive on a logarithmic scale; "
                f"got {self.low} to {self.high} {self.unit}"
            )

    @property
    def width(self) -> float:
        """High less low; on a logarithmic scale the logarithm of their ratio, [-]."""
        return math.log(self.high / self.low) if self.log else self.high - self.low

    def from_unit(self, u: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The parameter at a place `u` in 0..1 between its bounds.

        >>> round(float(Range("warp", "N/m", 3.0, 3000.0).from_unit(jnp.asarray(0.5))), 1)
        94.9
        """
        if self.log:
            return jnp.exp(jnp.log(self.low) * (1 - u) + jnp.log(self.high) * u)
        return self.low * (1 - u) + self.high * u

    def to_unit(self, value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The inverse of `from_unit`."""
        scale = jnp.log if self.log else jnp.asarray
        low, high = scale(jnp.asarray(self.low, float)), scale(jnp.asarray(self.high, float))
        return (scale(value) - low) / (high - low)


LOSSES = (Range("damping", "s", 3e-4, 1e-1), Range("friction", "-", 0.1, 1.0))
UNIFORM_DEVIATION = 0.29  # of a uniform distribution from 0 to 1

Prior = tuple[Float[Array, " dim"], Float[Array, "dim dim"]]


class ParameterSpace(eqx.Module):
    """Which fabrics an estimator may choose from: a map from the unit cube to them."""

    ranges: eqx.AbstractVar[tuple[Range, ...]]

    @abc.abstractmethod
    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""

    @abc.abstractmethod
    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies; outside of it, beyond the bounds."""

    @property
    def dim(self) -> int:
        """How many numbers a member has."""
        return len(self.ranges)

    def values(self, u: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The parameters, in the order and the units of `ranges`, at a point of the unit cube."""
        return jnp.stack([bound.from_unit(u[i]) for i, bound in enumerate(self.ranges)])

    def places(self, *values: Float[Array, ""]) -> Float[Array, " dim"]:
        """Where the last parameters are between their bounds, 0 to 1; the inverse of `values`."""
        ranges = self.ranges[self.dim - len(values) :]
        return jnp.stack([r.to_unit(value) for r, value in zip(ranges, values, strict=True)])

    def prior(self) -> Prior:
        """What is known of a place before any recording: its mean, and its precision, the inverse
        of its covariance. By default those of a uniform distribution over the cube.
        """
        return jnp.full(self.dim, 0.5, float), jnp.eye(self.dim, dtype=float) / UNIFORM_DEVIATION**2

    def middle(self) -> Fabric:
        """The fabric in the middle of all ranges: what one assumes knowing nothing."""
        return self(jnp.full(self.dim, 0.5, float))


class ExtendedSpace(ParameterSpace):
    """The fabrics of another space, whose laws have some numbers more.

    - `space`: the other one, of constant stiffness.
    - `extra`: ranges of the numbers that this one adds.
    """

    space: ParameterSpace
    ranges: tuple[Range, ...] = eqx.field(static=True)
    extra: ClassVar[tuple[Range, ...]]

    @classmethod
    def make(cls, space: ParameterSpace) -> "ExtendedSpace":
        """From a space of constant stiffness."""
        return cls(space=space, ranges=(*space.ranges, *cls.extra))

    @abc.abstractmethod
    def extended(self, fabric: Fabric, values: Float[Array, " extra"]) -> Fabric:
        """The fabric of the other space, with the laws that have these values."""

    @abc.abstractmethod
    def reduced(self, fabric: Fabric) -> tuple[Fabric, Float[Array, " extra"]]:
        """The fabric of the other space, and where the values are between their bounds."""

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        count = len(self.extra)
        return self.extended(self.space(u[:-count]), self.values(u)[-count:])

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies."""
        inner, places = self.reduced(fabric)
        return jnp.concatenate([self.space.to_unit(inner), places])


class OrthotropicSpace(ParameterSpace):
    """Orthotropic fabrics of a given areal density.

    Parameters:

    - warp, weft: stiffness in a uniaxial pull [N/m], which is C11 and C22 less C12^2 over the other
      one. A motion determines these, where C11 alone would go up and down with C12.
    - shear: C33 [N/m].
    - coupling: C12 / sqrt(C11 C22) [-], within -1..1, so that C stays positive definite while C12
      may be negative.
    - bending [N m], damping [s], friction [-].

    Fields:

    - `density`: areal density, [kg/m^2]. It is given, since a motion under gravity determines only
      the ratio of stiffness to density.
    - `thickness`: contact thickness, [m].
    """

    density: Float[Array, ""]
    thickness: Float[Array, ""]
    ranges: tuple[Range, ...] = eqx.field(
        static=True,
        default=(
            Range("warp", "N/m", 3.0, 3000.0),
            Range("weft", "N/m", 3.0, 3000.0),
            Range("shear", "N/m", 0.5, 500.0),
            Range("coupling", "-", -0.9, 0.9, log=False),
            Range("bending", "N m", 1e-7, 1e-3),
            Range("damping", "s", 1e-3, 1e-1),
            Range("friction", "-", 0.1, 1.0),
        ),
    )

    @classmethod
    def make(cls, density: float, thickness: float = 1e-3) -> "OrthotropicSpace":
        """The space of an areal density [kg/m^2] and a thickness [m], which must be positive."""
        if not (density > 0 and thickness > 0):
            raise ValueError(
                f"areal density and thickness must be positive, got {density} kg/m^2 and "
                f"{thickness} m"
            )
        return cls(density=jnp.asarray(density, float), thickness=jnp.asarray(thickness, float))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        warp, weft, c33, coupling, bending, damping, friction = self.values(u)
        c11, c22 = warp / (1 - coupling**2), weft / (1 - coupling**2)
        c12 = coupling * jnp.sqrt(c11 * c22)
        return Fabric(
            self.density,
            OrthotropicMembrane(c11, c12, c22, c33),
            PlateBending.make(bending),
            damping,
            friction,
            self.thickness,
            jnp.zeros((), float),
        )

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies; outside of it, beyond the bounds."""
        law, bending = constant_laws(fabric)
        coupling = law.c12 / jnp.sqrt(law.c11 * law.c22)
        held = 1 - coupling**2
        values = (held * law.c11, held * law.c22, law.c33, coupling, bending.stiffness)
        return self.places(*values, fabric.damping, fabric.friction)


class IsotropicSpace(ParameterSpace):
    """Isotropic sheets, as DiffCP has them: Young's modulus times thickness [N/m], Poisson's ratio.

    The bending stiffness is that of a solid plate of the same modulus and some `plate` thickness
    [m]. Areal density [kg/m^2] and contact thickness [m] are given, and damping [s] and friction
    where they are not the last of the ranges.
    """

    density: Float[Array, ""]
    plate: Float[Array, ""]
    damping: Float[Array, ""]
    friction: Float[Array, ""]
    thickness: Float[Array, ""]
    ranges: tuple[Range, ...] = eqx.field(
        static=True,
        default=(Range("E h", "N/m", 10.0, 1000.0), Range("nu", "-", 0.05, 0.45, log=False)),
    )

    @classmethod
    def make(
        cls,
        density: float,
        plate: float = 1e-3,
        damping: float = 0.01,
        friction: float = 0.5,
        thickness: float = 1e-3,
        losses: tuple[Range, ...] = (),
    ) -> "IsotropicSpace":
        """The space of these numbers, of which all but damping and friction must be positive.

        `losses`: `LOSSES` makes damping and friction parameters.
        """
        if not min(density, plate, thickness) > 0 or min(damping, friction) < 0:
            raise ValueError(
                "areal density [kg/m^2], plate and contact thickness [m] must be positive, damping "
                f"[s] and friction not negative, got {density}, {plate}, {thickness}, {damping} "
                f"and {friction}"
            )
        space = cls(
            density=jnp.asarray(density, float),
            plate=jnp.asarray(plate, float),
            damping=jnp.asarray(damping, float),
            friction=jnp.asarray(friction, float),
            thickness=jnp.asarray(thickness, float),
        )
        return dataclasses.replace(space, ranges=(*space.ranges, *losses))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        modulus, ratio, *losses = self.values(u)
        damping, friction = losses or (self.damping, self.friction)
        c11 = modulus / (1 - ratio**2)
        membrane = OrthotropicMembrane(c11, ratio * c11, c11, modulus / (2 * (1 + ratio)))
        bending = PlateBending(c11 * self.plate**2 / 12, ratio)
        return Fabric(
            self.density,
            membrane,
            bending,
            damping,
            friction,
            self.thickness,
            jnp.zeros((), float),
        )

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where the isotropic part of a fabric's membrane lies: C11 and C22 averaged."""
        law, _ = constant_laws(fabric)
        stiffness = (law.c11 + law.c22) / 2
        ratio = law.c12 / stiffness
        values = ((1 - ratio**2) * stiffness, ratio)
        values += (fabric.damping, fabric.friction)[: self.dim - 2]
        return self.places(*values)


class InformedSpace(ParameterSpace):
    """A space with a normal distribution over its places instead of a uniform one.

    - `space`: the space itself.
    - `mean`, `precision`: of the place; the precision is the inverse of its covariance.
    - `measured`: whether tests of this very fabric told them, and not what fabrics alike are.
    """

    space: ParameterSpace
    mean: Float[Array, " dim"]
    precision: Float[Array, "dim dim"]
    ranges: tuple[Range, ...] = eqx.field(static=True)
    measured: bool = eqx.field(static=True, default=False)

    @classmethod
    def make(
        cls,
        space: ParameterSpace,
        mean: Float[Array, " dim"],
        precision: Float[Array, "dim dim"],
        measured: bool = False,
    ) -> "InformedSpace":
        """Raises `ValueError` for a mean or a precision of another size than the space's."""
        if mean.shape != (space.dim,) or precision.shape != (space.dim, space.dim):
            raise ValueError(
                f"a space of {space.dim} parameters needs as many means and a precision of "
                f"{space.dim} x {space.dim}, got {mean.shape} and {precision.shape}"
            )
        means, known = jnp.asarray(mean, float), jnp.asarray(precision, float)
        return cls(space=space, mean=means, precision=known, ranges=space.ranges, measured=measured)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        return self.space(u)

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies."""
        return self.space.to_unit(fabric)

    def prior(self) -> Prior:
        """The mean and the precision."""
        return self.mean, self.precision
