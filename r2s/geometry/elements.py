"""What a moved sheet shows at its elements: strain of faces, angle and curvature of hinges.

A hinge is an inner edge with its two triangles. All functions take positions [m] in the world.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.geometry.mesh import Mesh

Positions = Float[Array, "vertex 3"]


def deformation_gradient(
    corners: Float[Array, "3 3"], inverse: Float[Array, "2 2"]
) -> Float[Array, "3 2"]:
    """F = [x1 - x0, x2 - x0] Dm^-1 [-]: the world images of the unit warp and weft vectors.

    `corners` are the triangle's positions [m], `inverse` the inverse of its rest edges [1/m].
    """
    edges = jnp.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
    return edges @ inverse


def green_strain(corners: Float[Array, "3 3"], inverse: Float[Array, "2 2"]) -> Float[Array, " 3"]:
    """Green strain (E11, E22, 2 E12) [-] of a triangle, E = (F^T F - 1) / 2."""
    deformation = deformation_gradient(corners, inverse)
    warp, weft = deformation[:, 0], deformation[:, 1]
    return jnp.stack([(warp @ warp - 1) / 2, (weft @ weft - 1) / 2, warp @ weft])


def strains(mesh: Mesh, x: Positions) -> Float[Array, "face 3"]:
    """Green strain (E11, E22, 2 E12) [-] of every face."""
    return jax.vmap(green_strain)(x[mesh.faces], mesh.inverse)


def area_normals(mesh: Mesh, x: Positions) -> Float[Array, "face 3"]:
    """Normals of the faces, as long as their areas, [m^2]."""
    corners = x[mesh.faces]
    return jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


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


def hinge_angles(mesh: Mesh, x: Positions) -> Float[Array, " hinge"]:
    """Angle [rad] of every hinge."""
    return jax.vmap(hinge_angle)(x[mesh.hinges])


def unwrapped(
    angle: Float[Array, "*hinge"], near: Float[Array, "*hinge"]
) -> Float[Array, "*hinge"]:
    """The angle [rad] plus the whole turns that bring it nearest to another one.

    A hinge that folds right over then goes on from pi, and does not jump to minus pi.
    """
    return angle + 2 * jnp.pi * jnp.round((near - angle) / (2 * jnp.pi))


def curvature_per_angle(mesh: Mesh) -> Float[Array, " hinge"]:
    """Curvature over angle of every hinge: the length of its edge over its area, [1/m]."""
    return mesh.hinge_length / mesh.hinge_area


def hinge_curvatures(mesh: Mesh, angles: Float[Array, " hinge"]) -> Float[Array, " hinge"]:
    """Curvature [1/m] of every hinge at an angle [rad], less its curvature at rest."""
    return angles * curvature_per_angle(mesh) - mesh.rest_curvature


def hinge_curvature_gradients(mesh: Mesh, x: Positions) -> Float[Array, "hinge 4 3"]:
    """Derivative [1/m^2] of every hinge's curvature in its four corners."""
    return curvature_per_angle(mesh)[:, None, None] * jax.vmap(hinge_angle_gradient)(x[mesh.hinges])


def vertex_masses(mesh: Mesh, density: Float[Array, ""]) -> Float[Array, " vertex"]:
    """Lumped mass [kg] of every vertex of a sheet, from its areal density [kg/m^2]."""
    return density * mesh.vertex_area
