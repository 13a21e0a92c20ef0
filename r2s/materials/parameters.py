"""Parameter spaces: which numbers of a fabric an estimator may move, and within which bounds.

A space maps a point of the unit cube to a fabric, so that one flat vector serves gradients,
sensitivities, multi-start and sampling.
"""

import abc
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.units import not_negative, positive
from r2s.materials.fabric import Fabric, check_density, constant_laws
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import PlateBending
from r2s.materials.stiffening import HALF, SofteningPlate, StiffeningMembrane


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
        """The parameters, in the order and the units of `ranges`, at a point of the unit cube.

        Raises `ValueError` for a point of another dimension.
        """
        if jnp.shape(u) != (self.dim,):
            names = ", ".join(bound.name for bound in self.ranges)
            shape = jnp.shape(u)
            raise ValueError(f"expected {self.dim} numbers from 0 to 1 ({names}), got {shape}")
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
        """The fabric in the middle of all ranges: an assumption without any information."""
        return self(jnp.full(self.dim, 0.5, float))


class ExtendedSpace(ParameterSpace):
    """The fabrics of another space, whose laws have some numbers more.

    - `space`: the other one, of constant stiffness.
    - `extra`: ranges of the numbers that this one adds. `kind`: the law that has them, and
      `name` in a list of laws. `FROM` of `r2s.estimation.default_spaces` is theirs, too.
    """

    space: ParameterSpace
    ranges: tuple[Range, ...] = eqx.field(static=True)
    extra: ClassVar[tuple[Range, ...]]
    kind: ClassVar[type]
    name: ClassVar[str]
    origins: ClassVar[dict[str, str]] = {}

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
      one. A motion determines these, but hardly C11 apart from C12.
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
        positive("kg/m^2", density=density)
        check_density(density)
        positive("m", thickness=thickness)
        return cls(density=jnp.asarray(density, float), thickness=jnp.asarray(thickness, float))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        warp, weft, c33, coupling, bending, damping, friction = self.values(u)
        c11, c22 = warp / (1 - coupling**2), weft / (1 - coupling**2)
        membrane = OrthotropicMembrane(c11, coupling * jnp.sqrt(c11 * c22), c22, c33)
        others = (damping, friction, self.thickness, jnp.zeros((), float))
        return Fabric(self.density, membrane, PlateBending.make(bending), *others)

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
        positive("kg/m^2", density=density)
        check_density(density)
        positive("m", plate=plate, thickness=thickness)
        not_negative("s", damping=damping)
        not_negative("-", friction=friction)
        space = cls(
            density=jnp.asarray(density, float),
            plate=jnp.asarray(plate, float),
            damping=jnp.asarray(damping, float),
            friction=jnp.asarray(friction, float),
            thickness=jnp.asarray(thickness, float),
        )
        return replace(space, ranges=(*space.ranges, *losses))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        modulus, ratio, *losses = self.values(u)
        damping, friction = losses or (self.damping, self.friction)
        c11 = modulus / (1 - ratio**2)
        membrane = OrthotropicMembrane(c11, ratio * c11, c11, modulus / (2 * (1 + ratio)))
        bending = PlateBending(c11 * self.plate**2 / 12, ratio)
        others = (damping, friction, self.thickness, jnp.zeros((), float))
        return Fabric(self.density, membrane, bending, *others)

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where the isotropic part of a fabric's membrane lies: C11 and C22 averaged."""
        law, _ = constant_laws(fabric)
        stiffness = (law.c11 + law.c22) / 2
        ratio = law.c12 / stiffness
        values = ((1 - ratio**2) * stiffness, ratio)
        values += (fabric.damping, fabric.friction)[: self.dim - 2]
        return self.places(*values)


STIFFENING = (
    Range("stiffening", "-", 1.02, 1000.0),
    Range("knee warp", "-", 3e-3, 10.0),
    Range("knee weft", "-", 3e-3, 10.0),
)


def stiffens(ranges: Iterable[Range]) -> bool:
    """Whether parameters of a space, or of an estimate, are of yarns that may stiffen."""
    return STIFFENING[0].name in {bounds.name for bounds in ranges}


class StiffeningSpace(ExtendedSpace):
    """The fabrics of a space of constant stiffness, with yarns that stiffen
    (`r2s.materials.stiffening`).

    Parameters: those of the other space, at small strain, and

    - stiffening: of the tangent far stretched to that at rest, [-].
    - knee warp, knee weft: the stretch less 1 at which half of the growth is reached, [-]. Pulls of
      knits along wales and courses cannot be followed with one knee for both.
    """

    extra: ClassVar[tuple[Range, ...]] = STIFFENING
    kind: ClassVar[type] = StiffeningMembrane
    name: ClassVar[str] = "stiffening"

    def extended(self, fabric: Fabric, values: Float[Array, " extra"]) -> Fabric:
        """The fabric, stiffening."""
        ratio, *knees = values
        strains = [((1 + knee) ** 2 - 1) / 2 / HALF for knee in knees]
        membrane = StiffeningMembrane(fabric.membrane, ratio, *strains)
        return replace(fabric, membrane=membrane)

    def reduced(self, fabric: Fabric) -> tuple[Fabric, Float[Array, " extra"]]:
        """The fabric at small strain; one that does not stiffen has the least ratio."""
        law = fabric.membrane
        if not isinstance(law, StiffeningMembrane):
            least = self.ranges[-3].to_unit(jnp.asarray(self.ranges[-3].low))
            return fabric, jnp.stack([least, 0.5, 0.5])
        knees = (jnp.sqrt(1 + 2 * HALF * strain) - 1 for strain in (law.knee, law.knee_weft))
        small = replace(fabric, membrane=law.small)
        return small, self.places(law.ratio, *knees)


# the loss below 8/9, so that the moment grows; knees where sheets of decimetres bend
SOFTENING = (
    Range("bending loss", "-", 0.0, 0.85, log=False),
    Range("bending knee", "1/m", 3.0, 300.0),
)


class SofteningSpace(ExtendedSpace):
    """The fabrics of a space of constant bending stiffness, whose bending softens
    (`SofteningPlate`).

    Parameters: those of the other space, at small curvature, and

    - bending loss: share of the bending stiffness that is lost at large curvatures, [-].
    - bending knee: curvature at which half of it is lost, [1/m].
    """

    extra: ClassVar[tuple[Range, ...]] = SOFTENING
    kind: ClassVar[type] = SofteningPlate
    name: ClassVar[str] = "softening"

    def extended(self, fabric: Fabric, values: Float[Array, " extra"]) -> Fabric:
        """The fabric, softening."""
        return replace(fabric, bending=SofteningPlate(fabric.bending, *values))

    def reduced(self, fabric: Fabric) -> tuple[Fabric, Float[Array, " extra"]]:
        """The fabric at small curvature; one that does not soften loses nothing."""
        law = fabric.bending
        if not isinstance(law, SofteningPlate):
            return fabric, jnp.array([0.0, 0.5])
        small = replace(fabric, bending=law.small)
        return small, self.places(law.loss, law.knee)


EXTENDED = {each.name: each for each in (StiffeningSpace, SofteningSpace)}  # by law


class InformedSpace(ParameterSpace):
    """A space with a normal distribution over its places instead of a uniform one.

    - `space`: the space itself.
    - `mean`, `precision`: of the place; the precision is the inverse of its covariance.
    - `measured`: whether they come from tests of this fabric, and not from similar fabrics.
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
        mean, precision = jnp.asarray(mean, float), jnp.asarray(precision, float)
        ranges = space.ranges
        return cls(space=space, mean=mean, precision=precision, ranges=ranges, measured=measured)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        return self.space(u)

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies."""
        return self.space.to_unit(fabric)

    def prior(self) -> Prior:
        """The mean and the precision."""
        return self.mean, self.precision
