"""Bending: the angle of a hinge between two triangles, and the energy that a fabric stores in it.

A hinge is an edge of rest length l with the rest area A of its two triangles. Its curvature is
theta l / A, its energy A times the law's energy per area. On a grid of squares whose lines stay
straight that is the energy of the bent continuum exactly, for bending along the grid's lines.
Across its diagonals it is up to half as much again where these alternate, and between once and
three times as much where they are parallel, at any resolution. A strip along the warp, free to
zigzag or twist, is softer: 1 / (1 / warp + 1 / (4 bias)) of hinge stiffnesses, 0.8 of a stiffness
that is the same in all directions. `r2s.laws.plate` has neither flaw.

A law is a pytree of parameters with two methods: `at`, which gives the law of one hinge from the
direction across which it bends and its curvature, and `energy_density` of a curvature.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.units import Scalar, isotropic_bending


@runtime_checkable
class BendingLaw(Protocol):
    """What the cloth asks of a bending law."""

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> "BendingLaw":
        """The law that a time step uses for a hinge which starts near this curvature [1/m].

        `direction` is the angle [rad], 0 to pi/2, between the warp and the line that the hinge
        bends, which is at right angles to its edge: 0 when warp yarns bend, pi/2 for weft yarns.
        """
        ...

    def energy_density(self, curvature: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        ...


class HingeBending(eqx.Module):
    """Bending with constant stiffness.

    - `stiffness`: moment per curvature and width, [N m].
    """

    stiffness: Float[Array, "*batch"]

    @classmethod
    def isotropic(
        cls, youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar
    ) -> "HingeBending":
        """Of a solid plate, from Young's modulus [Pa], Poisson's ratio [-] and thickness [m]."""
        stiffness = isotropic_bending(youngs_modulus, poissons_ratio, thickness)
        return cls(jnp.asarray(stiffness, float))

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> "HingeBending":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, curvature: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        return self.stiffness * curvature**2 / 2


class OrthotropicBending(eqx.Module):
    """Bending whose constant stiffness depends on the direction, as warp and weft yarns do.

    - `warp`, `bias`, `weft`: moment per curvature and width [N m] for bending along 0, 45 and 90
      degrees from the warp; linear in the angle between them.
    """

    warp: Float[Array, "*batch"]
    bias: Float[Array, "*batch"]
    weft: Float[Array, "*batch"]

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> HingeBending:
        """The stiffness along a direction [rad]."""
        quarter = 4 * direction / jnp.pi  # 0 warp, 1 bias, 2 weft
        to_bias, to_weft = jnp.clip(quarter, 0, 1), jnp.clip(quarter - 1, 0, 1)
        across = self.warp + to_bias * (self.bias - self.warp)
        return HingeBending(across + to_weft * (self.weft - self.bias))


class SpringBending(eqx.Module):
    """The bending springs of a mass-spring cloth, between vertices two apart.

    A spring over two cells of length h shortens to cos(theta / 2) of its length when the cells
    turn by theta = curvature h. Its energy is of fourth order in the curvature: a flat sheet of
    springs has no bending stiffness at all, one of curvature k has 3 stiffness h^4 k^2 / 32.

    - `stiffness`: force per width and stretch, [N/m].
    - `spacing`: h, [m].
    """

    stiffness: Float[Array, "*batch"]
    spacing: Float[Array, "*batch"]

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> "SpringBending":
        """Itself."""
        return self

    def energy_density(self, curvature: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        return self.stiffness / 2 * (1 - jnp.cos(curvature * self.spacing / 2)) ** 2


@jax.custom_jvp
def hinge_angle(corners: Float[Array, "4 3"]) -> Float[Array, ""]:
    """Signed angle [rad] between the normals of two triangles that share an edge.

    `corners` [m]: the two ends of the edge, then the two vertices opposite to it. Zero when flat.
    The angle comes from an arctangent of two arguments, and its derivative from `angle_gradient`,
    so that both are finite and exact everywhere but at a triangle of no area.
    """
    edge, left, right = _normals(corners)
    sine = jnp.cross(left, right) @ edge / jnp.sqrt(edge @ edge)
    return jnp.arctan2(sine, left @ right)


def angle_gradient(corners: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Derivative [rad/m] of `hinge_angle` in its corners.

    An opposite vertex turns its triangle by its motion along the normal over its height; what the
    ends of the edge do follows, since no rigid motion changes the angle.
    """
    start, end, to_left, to_right = corners
    edge, left, right = _normals(corners)
    length = jnp.sqrt(edge @ edge)
    of_left, of_right = -length * left / (left @ left), -length * right / (right @ right)
    share = lambda point: (point - start) @ edge / length**2  # 0 at the start, 1 at the end
    left_share, right_share = share(to_left), share(to_right)
    of_end = -left_share * of_left - right_share * of_right
    of_start = -(1 - left_share) * of_left - (1 - right_share) * of_right
    return jnp.stack([of_start, of_end, of_left, of_right])


@hinge_angle.defjvp
def _hinge_angle_jvp(primals, tangents):
    return hinge_angle(*primals), jnp.sum(angle_gradient(*primals) * tangents[0])


def _normals(corners):
    """The edge [m], and the normals of its two triangles, twice as long as their areas [m^2]."""
    start, end, left, right = corners
    edge = end - start
    return edge, jnp.cross(edge, left - start), jnp.cross(right - start, edge)


def unwrapped(
    angle: Float[Array, "*hinge"], near: Float[Array, "*hinge"]
) -> Float[Array, "*hinge"]:
    """The angle [rad] plus the whole turns that bring it nearest to another one.

    So that a hinge that folds right over goes on from pi, and does not jump to minus pi.
    """
    return angle + 2 * jnp.pi * jnp.round((near - angle) / (2 * jnp.pi))
