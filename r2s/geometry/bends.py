"""Where the bending of a sheet is taken: angles between two wings at an axis.

A bend is an axis and two wings, each a difference of vertices. In a triangle mesh it is a hinge: an
inner edge with its two triangles. In a grid (`r2s.geometry.plate_elements`) wings are the edges on
either side of a vertex and the axis is the line across them. The angle is signed, 0 when flat, and
keeps its meaning when the wings fold right over; over a rest length it is a curvature.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

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

    @classmethod
    def of_hinges(
        cls, hinges: Int[np.ndarray, "hinge 4"], per_angle: Float[np.ndarray, " hinge"]
    ) -> "Bends":
        """The hinges of a flat mesh of triangles, with their curvature over angle [1/m]."""
        flat = jnp.zeros(len(hinges), float)
        return cls(jnp.asarray(hinges, int), None, jnp.asarray(per_angle, float), flat)

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
        second = jax.vmap(jax.jacfwd(hinge_angle_gradient))(self.corners(x))
        second = (moments * self.per_angle)[:, None, None, None, None] * second
        if self.weights is None:
            return second
        return jnp.einsum("bcv,bcidj,bdw->bviwj", self.weights, second, self.weights)


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

    A bend that folds right over then goes on from pi, and does not jump to minus pi.
    """
    return angle + 2 * jnp.pi * jnp.round((near - angle) / (2 * jnp.pi))
