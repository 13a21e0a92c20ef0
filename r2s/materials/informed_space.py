"""A parameter space of whose places something is known beforehand, as laboratory tests tell it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Prior, Range


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
