"""Bending: the angle of a hinge between two triangles, and the energy that a fabric stores in it.

A hinge is an edge of rest length l with the rest area A of its two triangles. Its curvature is
theta l / A, its energy A times the law's energy per area. On a grid of squares that is the energy
of the bent continuum exactly, for bending along the grid's lines; across its diagonals it is up to
half as much again, at any resolution.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class HingeBending(eqx.Module):
    """Bending with constant stiffness.

    - `stiffness`: moment per curvature and width, [N m].
    """

    stiffness: Float[Array, "*batch"]

    def energy_density(self, curvature: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        return self.stiffness * curvature**2 / 2


def hinge_angle(corners: Float[Array, "4 3"]) -> Float[Array, ""]:
    """Signed angle [rad] between the normals of two triangles that share an edge.

    `corners` [m]: the two ends of the edge, then the two vertices opposite to it. Zero when flat.
    The angle comes from an arctangent of two arguments, so that its gradient is finite and exact
    everywhere but at a triangle of no area.
    """
    start, end, left, right = corners
    edge = end - start
    normal_left = jnp.cross(edge, left - start)
    normal_right = jnp.cross(right - start, edge)
    sine = jnp.cross(normal_left, normal_right) @ edge / jnp.sqrt(edge @ edge)
    return jnp.arctan2(sine, normal_left @ normal_right)


def unwrapped(
    angle: Float[Array, "*hinge"], near: Float[Array, "*hinge"]
) -> Float[Array, "*hinge"]:
    """The angle [rad] plus the whole turns that bring it nearest to another one.

    So that a hinge that folds right over goes on from pi, and does not jump to minus pi.
    """
    return angle + 2 * jnp.pi * jnp.round((near - angle) / (2 * jnp.pi))
