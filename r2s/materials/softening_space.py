"""Fabrics that soften as they bend: a space of constant bending stiffness, and two numbers more."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ExtendedSpace, Range
from r2s.materials.stiffening import SofteningPlate

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

    def extended(self, fabric: Fabric, values: Float[Array, " extra"]) -> Fabric:
        """The fabric, softening."""
        return dataclasses.replace(fabric, bending=SofteningPlate(fabric.bending, *values))

    def reduced(self, fabric: Fabric) -> tuple[Fabric, Float[Array, " extra"]]:
        """The fabric at small curvature; one that does not soften loses nothing."""
        law = fabric.bending
        if not isinstance(law, SofteningPlate):
            return fabric, jnp.array([0.0, 0.5])
        small = dataclasses.replace(fabric, bending=law.small)
        return small, self.places(law.loss, law.knee)
