"""Fabrics that soften as they bend: a space of constant bending stiffness, and two numbers more."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range
from r2s.materials.stiffening import SofteningPlate

# the loss below 8/9, so that the moment grows; knees where sheets of decimetres bend
SOFTENING = (
    Range("bending loss", "-", 0.0, 0.85, log=False),
    Range("bending knee", "1/m", 3.0, 300.0),
)


class SofteningSpace(ParameterSpace):
    """The fabrics of another space, whose bending softens (`SofteningPlate`).

    Parameters: those of the other space, at small curvature, and

    - bending loss: share of the bending stiffness that is lost at large curvatures, [-].
    - bending knee: curvature at which half of it is lost, [1/m].

    Fields: `space`, of constant bending stiffness.
    """

    space: ParameterSpace
    ranges: tuple[Range, ...] = eqx.field(static=True)

    @classmethod
    def make(
        cls, space: ParameterSpace, softening: tuple[Range, Range] = SOFTENING
    ) -> "SofteningSpace":
        """From a space of constant bending stiffness and the ranges of the two numbers more."""
        return cls(space=space, ranges=(*space.ranges, *softening))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        fabric = self.space(u[:-2])
        loss, knee = self.values(u)[-2:]
        return dataclasses.replace(fabric, bending=SofteningPlate(fabric.bending, loss, knee))

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric lies; one that does not soften loses nothing."""
        law = fabric.bending
        if not isinstance(law, SofteningPlate):
            return jnp.concatenate([self.space.to_unit(fabric), jnp.array([0.0, 0.5])])
        inner = self.space.to_unit(dataclasses.replace(fabric, bending=law.small))
        numbers = zip(self.ranges[-2:], (law.loss, law.knee), strict=True)
        return jnp.concatenate([inner, jnp.stack([r.to_unit(n) for r, n in numbers])])
