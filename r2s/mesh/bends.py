"""The bends of a sheet: angles between two wings at an axis.

A bend is an axis and two wings, each a difference of vertices. In a triangle mesh it is a hinge: an
inner edge with its two triangles. In a grid (`r2s.mesh.plate_elements`) wings are the edges on
either side of a vertex and the axis is the line across them. The angle is signed, 0 when flat, and
well defined up to a full fold; over a rest length it is a curvature.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r2s._util.arrays import once

Positions = Float[Array, "vertex 3"]


class Bends(eqx.Module):
    """The bends of a sheet.

    - `vertices`: that each bend depends on.
    - `weights`: of the vertices in its four corners: start and end of its axis, and the ends of its
      left and right wing, which begin where the axis does. None: the vertices are the corners.
    - `per_angle`: curvature over angle, [1/m].
    - `rest_curvature`: where it stores no energy, [1/m]; 0 for a flat sheet.
    """

    vertices: Int[Array, "bend corner"]
    weights: Float[Array, "bend 4 corner"] | None
    per_angle: Float[Array, " bend"]
    rest_curvature: Float[Array, " bend"]

    def corners(self, x: Positions) -> Float[Array, "bend 4 3"]:
        """The corners of every bend [m], up to a shift of each."""
        of_bend = x[self.vertices]
        if self.weights is None:
            return of_bend
        from_first = of_bend - of_bend[:, :1]  # places in the world would cost precision
        # a sum that XLA fuses: batched products of small matrices take it eight times as long
        return jnp.sum(self.weights[..., None] * from_first[:, None], axis=2)

    def angles(self, x: Positions) -> Float[Array, " bend"]:
        """Angle [rad] of every bend."""
        return jax.vmap(hinge_angle)(self.corners(x))

    def curvatures(self, angles: Float[Array, " bend"]) -> Float[Array, " bend"]:
        """Curvature [1/m] of every bend at an angle [rad], less its curvature at rest."""
        return angles * self.per_angle - self.rest_curvature

    def curvatures_at(self, x: Positions) -> Float[Array, " bend"]:
        """Curvature [1/m] of every bend at positions [m]."""
        return self.curvatures(self.angles(x))

    def gradients(self, x: Positions) -> Float[Array, "bend corner 3"]:
        """Derivative [1/m^2] of every bend's curvature in its vertices."""
        of_corners = jax.vmap(hinge_angle_gradient)(self.corners(x))
        if self.weights is not None:
            of_corners = jnp.sum(self.weights[..., None] * of_corners[:, :, None], axis=1)
        return self.per_angle[:, None, None] * of_corners

    def second_derivatives(
        self, x: Positions, moments: Float[Array, " bend"]
    ) -> Float[Array, "bend corner 3 corner 3"]:
        """`moments` times the second derivative of every bend's curvature in its vertices."""
        corners = jnp.moveaxis(self.corners(x), 0, -1)
        weights = jnp.eye(4, dtype=x.dtype)[..., None]
        if self.weights is not None:
            weights = jnp.moveaxis(self.weights, 0, -1)
        # the angle depends on the axis and the two wings
        vectors, shares = (
            (part[1] - part[0], part[2] - part[0], part[3] - part[0]) for part in (corners, weights)
        )
        second = once(_angle_second_derivatives, *vectors)
        scale = (moments * self.per_angle)[None, None, None]

        def spread(second):
            return [
                sum(scale * shares[j][:, None, None] * second[i, j][None] for j in _PARTS[i])
                for i in range(3)
            ]

        rows = once(spread, second)
        total = sum(shares[i][:, None, None, None] * rows[i].swapaxes(0, 1)[None] for i in range(3))
        return jnp.moveaxis(total, -1, 0)


class HingeElements(eqx.Module):
    """The hinges of a mesh as elements of one curvature each.

    - `bends`: the hinges themselves.
    - `areas`: rest areas of their two faces together, [m^2].
    """

    bends: Bends
    areas: Float[Array, " hinge"]

    @property
    def vertices(self) -> Int[Array, "hinge 4"]:
        """The ends of each hinge's edge, then the vertices opposite to it."""
        return self.bends.vertices

    def curvatures(self, bends: Float[Array, " hinge"]) -> Float[Array, " hinge"]:
        """The curvatures [1/m] of the hinges, from those of the bends."""
        return bends

    def gradients(self, bends: Float[Array, "hinge 4 3"]) -> Float[Array, "hinge 1 4 3"]:
        """The gradients [1/m^2] of the hinges, from those of the bends."""
        return bends[:, None]


_PARTS = ((0, 1, 2), (0, 1), (0, 2))  # the two wings are not coupled


def _angle_second_derivatives(
    axis: Float[Array, "3 bend"], left: Float[Array, "3 bend"], right: Float[Array, "3 bend"]
) -> dict[tuple[int, int], Float[Array, "3 3 bend"]]:
    """Second derivatives [rad/m^2] of the angle of bends in their axis (0), left (1) and right (2)
    wing [m]; the missing ones are zero. Bends are the last axis, over which loops vectorise.

    In a wing the derivative of the angle is -+ |axis| n / |n|^2 with n = axis x wing, in the axis
    it is that of either wing times minus the wing's share along the axis (`hinge_angle_gradient`).
    """
    second = {}
    squared = jnp.sum(axis**2, axis=0)[None]
    length = jnp.sqrt(squared)
    of_axis = jnp.zeros((3, 3, axis.shape[1]), axis.dtype)
    for place, wing, sign in ((1, left, 1), (2, right, -1)):
        normal = sign * jnp.cross(axis, wing, axis=0)
        area = jnp.sum(normal**2, axis=0)[None]
        unit = normal / jnp.sqrt(area)
        scale = (sign * length / area)[None]
        gradient = -length * normal / area
        in_wing = -scale * (_cross_matrix(axis) - 2 * _outer(unit, jnp.cross(unit, axis, axis=0)))
        in_axis = scale * (_cross_matrix(wing) - 2 * _outer(unit, jnp.cross(unit, wing, axis=0)))
        in_axis = in_axis - _outer(normal / area, axis / length)
        share = jnp.sum(wing * axis, axis=0)[None] / squared
        of_axis -= _outer(gradient, (wing - 2 * share * axis) / squared) + share[None] * in_axis
        second[place, place], second[place, 0] = in_wing, in_axis
        second[0, place] = in_axis.swapaxes(0, 1)
    return second | {(0, 0): of_axis}


def _outer(a: Float[Array, "3 bend"], b: Float[Array, "3 bend"]) -> Float[Array, "3 3 bend"]:
    return a[:, None] * b[None]


def _cross_matrix(a: Float[Array, "3 bend"]) -> Float[Array, "3 3 bend"]:
    """The matrix of a x."""
    none = jnp.zeros_like(a[0])
    rows = (none, -a[2], a[1]), (a[2], none, -a[0]), (-a[1], a[0], none)
    return jnp.stack([jnp.stack(row) for row in rows])


@jax.custom_jvp
def hinge_angle(corners: Float[Array, "4 3"]) -> Float[Array, ""]:
    """Signed angle [rad] between the normals of two triangles that share an edge; 0 when flat.

    `corners` [m] are the two ends of the edge, then the two vertices opposite to it. The angle
    comes from an arctangent of two arguments, and its derivative from `hinge_angle_gradient`, so
    that both are finite and exact everywhere but at a triangle of no area.
    """
    edge, left, right = _normals(corners)
    sine = jnp.cross(left, right) @ edge / jnp.sqrt(edge @ edge)
    return jnp.arctan2(sine, left @ right)


def hinge_angle_gradient(corners: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Derivative [rad/m] of `hinge_angle` in its corners.

    An opposite vertex turns its triangle by its motion along the normal over its height. The
    motion of the edge's ends follows, since no rigid motion changes the angle.
    """
    start, end, to_left, to_right = corners
    edge, left, right = _normals(corners)
    length = jnp.sqrt(edge @ edge)
    of_left, of_right = -length * left / (left @ left), -length * right / (right @ right)
    left_share = (to_left - start) @ edge / length**2  # 0 at the start of the edge, 1 at its end
    right_share = (to_right - start) @ edge / length**2
    of_end = -left_share * of_left - right_share * of_right
    of_start = -(1 - left_share) * of_left - (1 - right_share) * of_right
    return jnp.stack([of_start, of_end, of_left, of_right])


@hinge_angle.defjvp
def _hinge_angle_jvp(primals, tangents):
    return hinge_angle(*primals), jnp.sum(hinge_angle_gradient(*primals) * tangents[0])


def _normals(corners):
    """The edge [m], and the normals of its two triangles, twice as long as their areas [m^2]."""
    start, end, left, right = corners
    edge = end - start
    return edge, jnp.cross(edge, left - start), jnp.cross(right - start, edge)


def unwrapped(angle: Float[Array, "*bend"], near: Float[Array, "*bend"]) -> Float[Array, "*bend"]:
    """The angle [rad] plus the whole turns that bring it nearest to another one.

    So the angle of a bend that folds over does not jump from pi to minus pi.
    """
    return angle + 2 * jnp.pi * jnp.round((near - angle) / (2 * jnp.pi))
