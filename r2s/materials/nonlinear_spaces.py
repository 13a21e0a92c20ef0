"""Fabrics that stiffen as they stretch: a space of constant stiffness, and three numbers more."""

import dataclasses
from collections.abc import Iterable
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ExtendedSpace, Range
from r2s.materials.stiffening import HALF, SofteningPlate, StiffeningMembrane

STIFFENING = (
    Range("stiffening", "-", 1.02, 1000.0),
    Range("knee warp", "-", 3e-3, 10.0),
    Range("knee weft", "-", 3e-3, 10.0),
)


def stiffens(ranges: Iterable[Range]) -> bool:
    """Whether parameters of a space, or of an estimate, are of yarns that may stiffen."""
    return STIFFENING[0].name in {each.name for each in ranges}


class StiffeningSpace(ExtendedSpace):
    """The fabrics of a space of constant stiffness, with yarns that stiffen
    (`r2s.materials.stiffening`).

    Parameters: those of the other space, at small strain, and

    - stiffening: of the tangent far stretched to that at rest, [-].
    - knee warp, knee weft: the stretch less 1 at which half of the growth is reached, [-]. Pulls of
      knits along wales and courses cannot be followed with one knee for both.
    """

    extra: ClassVar[tuple[Range, ...]] = STIFFENING

    def extended(self, fabric: Fabric, values: Float[Array, " extra"]) -> Fabric:
        """The fabric, stiffening."""
        ratio, *knees = values
        strains = [((1 + knee) ** 2 - 1) / 2 / HALF for knee in knees]
        membrane = StiffeningMembrane(fabric.membrane, ratio, *strains)
        return dataclasses.replace(fabric, membrane=membrane)

    def reduced(self, fabric: Fabric) -> tuple[Fabric, Float[Array, " extra"]]:
        """The fabric at small strain; one that does not stiffen has the least ratio."""
        law = fabric.membrane
        if not isinstance(law, StiffeningMembrane):
            least = self.ranges[-3].to_unit(jnp.asarray(self.ranges[-3].low))
            return fabric, jnp.stack([least, 0.5, 0.5])
        knees = (jnp.sqrt(1 + 2 * HALF * strain) - 1 for strain in (law.knee, law.knee_weft))
        small = dataclasses.replace(fabric, membrane=law.small)
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
