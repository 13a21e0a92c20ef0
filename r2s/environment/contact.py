"""Contact: normal pressure, and Coulomb friction made smooth; a horizontal table."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

PRESSURE_STIFFNESS = 4e8  # [Pa/m^2]: 0.07 mm under a fabric's weight, 0.5 mm under 100 Pa
SLIP_SPEED = 2e-3  # [m/s]: below it friction fades to zero, so that it has a gradient


class Table(eqx.Module):
    """A horizontal table.

    - `height`: z of its surface, [m]; minus infinity where there is none.
    """

    height: Float[Array, "*batch"]

    @classmethod
    def make(cls, height: float | None = 0.0) -> "Table":
        """A table with its surface at z = `height` [m]; None: there is none."""
        return cls(jnp.asarray(-jnp.inf if height is None else height, float))

    def depth(
        self, position: Float[Array, "*vertex 3"], offset: Float[Array, ""]
    ) -> Float[Array, "*vertex"]:
        """How far [m] a point has come closer to the table than `offset` [m]; 0 when it has not."""
        return jnp.maximum(self.height + offset - position[..., 2], 0)


def normal_potential(depth: Float[Array, "*vertex"]) -> Float[Array, "*vertex"]:
    """Energy per area [J/m^2] of a depth [m]. Cubic: force and stiffness start smoothly at 0."""
    return PRESSURE_STIFFNESS * depth**3 / 3


def pressure(depth: Float[Array, "*vertex"]) -> Float[Array, "*vertex"]:
    """Normal pressure [Pa] at a depth [m], minus the gradient of `normal_potential`."""
    return PRESSURE_STIFFNESS * depth**2


def friction_dissipation(
    limit: Float[Array, "*vertex"], slip: Float[Array, "*vertex axis"]
) -> Float[Array, "*vertex"]:
    """The potential [W] of Coulomb friction, with `limit` [N] = coefficient x normal force.

    `slip` is the velocity along the surface, [m/s].

    Its negative gradient in velocity is the friction [N]: `limit` against the sliding direction,
    less below `SLIP_SPEED`.
    """
    return limit * (jnp.sqrt(jnp.sum(slip**2, axis=-1) + SLIP_SPEED**2) - SLIP_SPEED)
