"""Families: which numbers of a fabric an estimator may move, and within which bounds.

A family maps a point of the unit cube to a fabric, so that one flat vector serves gradients,
sensitivities, multi-start and sampling.
"""

import dataclasses
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.fabric import Fabric, constant_laws
from r2s.physics.membrane import OrthotropicMembrane
from r2s.physics.plate import PlateBending


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

    def value(self, u: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The parameter at a place `u` in 0..1 between its bounds."""
        if self.log:
            return jnp.exp(jnp.log(self.low) * (1 - u) + jnp.log(self.high) * u)
        return self.low * (1 - u) + self.high * u

    def place(self, value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The inverse of `value`."""
        scale = jnp.log if self.log else jnp.asarray
        low, high = scale(jnp.asarray(self.low, float)), scale(jnp.asarray(self.high, float))
        return (scale(value) - low) / (high - low)


MASS_DAMPING = Range("mass damping", "1/s", 1e-2, 10.0)


class OrthotropicFamily(eqx.Module):
    """Fabrics of one areal density, in all that a motion may determine.

    Membrane stiffness C11, C22, C33 [N/m]; coupling C12 / sqrt(C11 C22) [-], within -1..1, so that
    C stays positive definite while C12 may be negative; bending stiffness [N m]; damping [s];
    friction [-]; and, when it is the last of the ranges, mass damping [1/s], else none.

    - `density`: areal density, [kg/m^2], an input: a motion under gravity determines only the
      ratio of stiffness to density.
    - `thickness`: [m].
    """

    density: Float[Array, ""]
    thickness: Float[Array, ""]
    ranges: tuple[Range, ...] = eqx.field(
        static=True,
        default=(
            Range("C11", "N/m", 3.0, 3000.0),
            Range("C22", "N/m", 3.0, 3000.0),
            Range("C33", "N/m", 0.5, 500.0),
            Range("coupling", "-", -0.9, 0.9, log=False),
            Range("bending", "N m", 1e-7, 1e-3),
            Range("damping", "s", 1e-3, 1e-1),
            Range("friction", "-", 0.1, 1.0),
        ),
    )

    @classmethod
    def make(
        cls, density: float, thickness: float = 1e-3, mass_damping: Range | None = None
    ) -> "OrthotropicFamily":
        """The family of an areal density [kg/m^2] and a thickness [m], which must be positive.

        `mass_damping`, for example `MASS_DAMPING`, makes that one of its parameters. What brakes
        rigid motion is hard to tell from the air's drag, so by default it is not.
        """
        if not (density > 0 and thickness > 0):
            raise ValueError(
                f"areal density and thickness must be positive, got {density} kg/m^2 and "
                f"{thickness} m"
            )
        family = cls(jnp.asarray(density, float), jnp.asarray(thickness, float))
        if mass_damping is None:
            return family
        return dataclasses.replace(family, ranges=(*family.ranges, mass_damping))

    @property
    def dim(self) -> int:
        """How many numbers a member has."""
        return len(self.ranges)

    def values(self, u: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The parameters, in the order and the units of `ranges`, at a point of the unit cube."""
        return jnp.stack([bound.value(u[i]) for i, bound in enumerate(self.ranges)])

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        c11, c22, c33, coupling, bending, damping, friction, *others = self.values(u)
        c12 = coupling * jnp.sqrt(c11 * c22)
        return Fabric(
            self.density,
            OrthotropicMembrane(c11, c12, c22, c33),
            PlateBending.make(bending),
            damping,
            friction,
            self.thickness,
            others[0] if others else jnp.zeros((), float),
        )

    def locate(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point of the unit cube where a fabric lies; outside of it, beyond the bounds."""
        law, bending = constant_laws(fabric)
        coupling = law.c12 / jnp.sqrt(law.c11 * law.c22)
        values = (law.c11, law.c22, law.c33, coupling, bending.stiffness)
        values += (fabric.damping, fabric.friction, fabric.mass_damping)[: self.dim - 5]
        places = [bound.place(value) for bound, value in zip(self.ranges, values, strict=True)]
        return jnp.stack(places)

    def middle(self) -> Fabric:
        """The fabric in the middle of all ranges: what one assumes knowing nothing."""
        return self(jnp.full(self.dim, 0.5, float))
