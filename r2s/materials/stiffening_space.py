"""Fabrics that stiffen as they stretch: a space of constant stiffness, and three numbers more."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range
from r2s.materials.stiffening import HALF, StiffeningMembrane

STIFFENING = (
    Range("stiffening", "-", 1.02, 1000.0),
    Range("knee warp", "-", 3e-3, 10.0),
    Range("knee weft", "-", 3e-3, 10.0),
)


def stiffens(ranges: Iterable[Range]) -> bool:
    """Whether parameters of a space, or of an estimate, are of yarns that may stiffen."""
    return STIFFENING[0].name in {each.name for each in ranges}


class StiffeningSpace(ParameterSpace):
    """The fabrics of another space, with yarns that stiffen (`r2s.materials.stiffening`).

    Parameters: those of the other space, at small strain, and

    - stiffening: of the tangent far stretched to that at rest, [-].
    - knee warp, knee weft: the stretch less 1 at which half of the growth is reached, [-].

    Warp and weft have each their own knee: pulls of knits along wales and courses cannot be
    followed with one.

    Fields: `space`, of constant stiffness.
    """

    space: ParameterSpace
    ranges: tuple[Range, ...] = eqx.field(static=True)

    @classmethod
    def make(
        cls, space: ParameterSpace, stiffening: tuple[Range, Range, Range] = STIFFENING
    ) -> "StiffeningSpace":
        """From a space of constant stiffness and the ranges of the three numbers more."""
        return cls(space=space, ranges=(*space.ranges, *stiffening))

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        fabric = self.space(u[:-3])
        ratio, *knees = self.values(u)[-3:]
        strains = [((1 + knee) ** 2 - 1) / 2 / HALF for knee in knees]
        membrane = StiffeningMembrane(fabric.membrane, ratio, *strains)
        return dataclasses.replace(fabric, membrane=membrane)

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric lies; one that does not stiffen lies at the least ratio."""
        law = fabric.membrane
        if not isinstance(law, StiffeningMembrane):
            least = self.ranges[-3].to_unit(jnp.asarray(self.ranges[-3].low))
            return jnp.concatenate([self.space.to_unit(fabric), jnp.stack([least, 0.5, 0.5])])
        inner = self.space.to_unit(dataclasses.replace(fabric, membrane=law.small))
        knees = (jnp.sqrt(1 + 2 * HALF * strain) - 1 for strain in (law.knee, law.knee_weft))
        numbers = zip(self.ranges[-3:], (law.ratio, *knees), strict=True)
        return jnp.concatenate([inner, jnp.stack([r.to_unit(n) for r, n in numbers])])
