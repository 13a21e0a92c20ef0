"""The incremental potential: the energy that one implicit step minimises.

With the rate of BDF2 [1/s] the velocity at the end of a step is v = rate (x - x_anchor) and the
acceleration rate (v - v_anchor), both linear in the new positions x. The new positions are then
those that minimise

    inertia  m rate^2 / 2 |x - x_anchor - v_anchor / rate|^2
    + stored energy(x) + dissipation(v) / rate

(Ortiz and Stainier 1999; Kane et al. 2000; for contact Li et al. 2020). What has no potential is
lagged: the drag takes the normals, and the friction the normal force, of the start of the step.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.cloth.linear.elimination import Elimination
from r2s.cloth.linear.pattern import add_between, add_elements, assemble
from r2s.cloth.linear.system import Far
from r2s.cloth.self_contact.contacts import Contacts, contact_energy, contact_hessians
from r2s.fabrics.fabric import Fabric
from r2s.geometry.elements import (
    curvature_per_angle,
    green_strain,
    hinge_angle_gradient,
    hinge_angles,
    hinge_curvature_gradients,
    hinge_curvatures,
    unwrapped,
)
from r2s.geometry.mesh import Mesh
from r2s.laws.bending import BendingLaw
from r2s.laws.membrane import MembraneLaw
from r2s.units import GRAVITY
from r2s.world import contact
from r2s.world.air import Air
from r2s.world.contact import Table

Positions = Float[Array, "vertex 3"]
Blocks = Float[Array, "block 3 3"]


class IncrementalPotential(eqx.Module):
    """All that a step's potential depends on, beside the new positions.

    - `membrane`, `bending`: the fabric's laws as they stand in this step, one for each element.
    - `rate`: of the time-stepping formula, [1/s].
    - `x_anchor`, `v_anchor`: what the formula's velocity [m/s] and acceleration start from.
    - `strain_anchor`, `curvature_anchor`: likewise for the rates of strain [-] and of the hinges'
      curvature [1/m].
    - `angles`: of the hinges at the start of the step, [rad].
    - `area_normals`: of the faces at the start of the step, [m^2].
    - `friction_limit`: coefficient times normal force at the start of the step, [N].
    - `wind`: on the faces, [m/s].
    - `elimination`: how its Hessian is eliminated.
    - `contacts`: of the sheet with itself; None: it passes through itself.
    """

    mesh: Mesh
    fabric: Fabric
    membrane: MembraneLaw
    bending: BendingLaw
    air: Air
    table: Table
    rate: Float[Array, ""]
    x_anchor: Positions
    v_anchor: Positions
    strain_anchor: Float[Array, "face 3"]
    curvature_anchor: Float[Array, " hinge"]
    angles: Float[Array, " hinge"]
    area_normals: Float[Array, "face 3"]
    friction_limit: Float[Array, " vertex"]
    wind: Float[Array, "face 3"]
    elimination: Elimination
    contacts: Contacts | None = None


def potential(step: IncrementalPotential, x: Positions) -> Float[Array, ""]:
    """The incremental potential [J] at new positions [m]."""
    total = jnp.sum(_map(_face_energy, step, x[step.mesh.faces], *_faces(step)))
    total += _bending_energy(step, _curvatures(step, x))
    total += jnp.sum(_map(_vertex_energy, step, x, *_vertices(step)))
    if step.contacts is None:
        return total
    return total + contact_energy(step.contacts, step.fabric.thickness, step.rate, x, step.x_anchor)


@jax.jit  # so that it is traced once for all uses in a motion and its derivatives
def residual(step: IncrementalPotential, x: Positions) -> Positions:
    """The derivative [N] of the potential; zero where the forces on every vertex balance."""
    return jax.grad(potential, argnums=1)(step, x)


@jax.jit
def hessian(
    step: IncrementalPotential, x: Positions, hessian_blend: Float[Array, ""] | float = 1.0
) -> Blocks:
    """Second derivative [N/m] of the potential, as blocks of its pattern, but for `far_couplings`.

    With a `hessian_blend` of 0 it is a positive definite stand-in, whose Newton steps always
    descend: it leaves out the second derivative of the hinge angle, and the geometric stiffness of
    compressed directions, as is usual for cloth (Choi and Ko 2002). Between 0 and 1 it has that
    fraction of these.
    """
    pattern, blend = step.elimination.pattern, jnp.asarray(hessian_blend, x.dtype)
    faces = _map(_face_hessian, step, x[step.mesh.faces], *_faces(step), fixed=(blend,))
    bending = {step.bending.element: _bending_hessians(step, x)}
    vertices = _map(jax.hessian(_vertex_energy, argnums=1), step, x, *_vertices(step))
    blocks = assemble(pattern, vertices, faces=faces, **bending)
    blocks = jax.lax.cond(
        blend > 0,
        lambda: add_elements(blocks, pattern.hinges, blend * _angle_hessians(step, x)),
        lambda: blocks,
    )
    if step.contacts is None or not step.elimination.couples_all:
        return blocks
    return add_between(pattern, blocks, step.contacts.stencils, _contact_hessians(step, x))


def far_couplings(step: IncrementalPotential, x: Positions) -> Far | None:
    """What the second derivative [N/m] of the potential has outside of its pattern."""
    if step.contacts is None or step.elimination.couples_all:
        return None
    return Far(step.contacts.stencils, _contact_hessians(step, x))


def _map(function: Callable, step: IncrementalPotential, *elements: Any, fixed: tuple = ()) -> Any:
    """`function(step, *fixed, *element)` of all elements."""
    return jax.vmap(lambda *element: function(step, *fixed, *element))(*elements)


def _faces(step: IncrementalPotential):
    mesh = step.mesh
    rest = mesh.faces, step.membrane, mesh.inverse, mesh.area
    return *rest, step.strain_anchor, step.area_normals, step.wind


def _vertices(step: IncrementalPotential):
    return step.x_anchor, step.v_anchor, step.mesh.vertex_area, step.friction_limit


def _viscoelastic_energy(step, law: Any, strain: Array, anchor: Array) -> Array:
    """Stored energy and dissipation of one element, per area [J/m^2].

    The viscous stress is damping x tangent x rate, with the law's tangent at the anchor.
    """
    change = strain - anchor
    _, tangent_change = jax.jvp(jax.grad(law.energy_density), (anchor,), (change,))
    viscosity = step.fabric.damping * step.rate
    return law.energy_density(strain) + viscosity / 2 * jnp.sum(change * tangent_change)


def _drag_energy(step, face, normal, wind, middle):
    velocity = step.rate * (middle - step.x_anchor[face].mean(axis=0))
    return step.air.dissipation(velocity - wind, normal) / step.rate


def _face_energy(step, corners, face, law, inverse, area, anchor, normal, wind):
    strain = green_strain(corners, inverse)
    drag = _drag_energy(step, face, normal, wind, corners.mean(axis=0))
    return area * _viscoelastic_energy(step, law, strain, anchor) + drag


def _vertex_energy(step, x, x_anchor, v_anchor, area, limit):
    mass = step.fabric.density * area
    offset = x - x_anchor - v_anchor / step.rate
    depth = step.table.depth(x, step.fabric.thickness)
    velocity = step.rate * (x - x_anchor)
    drag = mass * step.fabric.mass_damping / 2 * jnp.sum(velocity**2)
    return (
        mass * step.rate**2 / 2 * jnp.sum(offset**2)
        + mass * GRAVITY * x[2]
        + area * contact.normal_potential(depth)
        + (contact.friction_dissipation(limit, velocity[:2]) + drag) / step.rate
    )


def _curvatures(step: IncrementalPotential, x: Positions) -> Float[Array, " hinge"]:
    return hinge_curvatures(step.mesh, unwrapped(hinge_angles(step.mesh, x), step.angles))


def _bending_elements(step: IncrementalPotential, hinges: Float[Array, " hinge"]):
    mesh, law = step.mesh, step.bending
    before = law.curvatures(mesh, step.curvature_anchor)
    return law.areas(mesh), law, law.curvatures(mesh, hinges), before


def _element_bending_energy(step, area, law, curvature, anchor):
    return area * _viscoelastic_energy(step, law, curvature, anchor)


def _bending_energy(step: IncrementalPotential, hinges: Float[Array, " hinge"]):
    return jnp.sum(_map(_element_bending_energy, step, *_bending_elements(step, hinges)))


def _bending_hessians(step: IncrementalPotential, x: Positions):
    """Second derivatives [N/m] of the bending energy of each element, but for `_angle_hessians`."""
    gradients = step.bending.gradients(step.mesh, hinge_curvature_gradients(step.mesh, x))
    elements = _bending_elements(step, _curvatures(step, x))
    stiffness = _map(jax.hessian(_element_bending_energy, argnums=3), step, *elements)
    if stiffness.ndim == 1:  # of a scalar curvature
        return jnp.einsum("e,eva,ewb->evawb", stiffness, gradients[:, 0], gradients[:, 0])
    return jnp.einsum("eiva,eij,ejwb->evawb", gradients, stiffness, gradients)


def _angle_hessians(step: IncrementalPotential, x: Positions):
    """What the second derivative [N/m] of the bending energy owes to that of the hinges' angles."""
    moments = jax.grad(_bending_energy, argnums=1)(step, _curvatures(step, x))
    second = jax.vmap(jax.jacfwd(hinge_angle_gradient))(x[step.mesh.hinges])
    return jnp.einsum("h,haibj->haibj", curvature_per_angle(step.mesh) * moments, second)


def _contact_hessians(step: IncrementalPotential, x: Positions):
    assert step.contacts is not None
    return contact_hessians(step.contacts, step.fabric.thickness, step.rate, x, step.x_anchor)


def _face_hessian(step, blend, corners, face, law, inverse, area, anchor, normal, wind):
    # exact with all of the stress, since the Green strain is quadratic in the corners
    strain, vjp = jax.vjp(lambda corners: green_strain(corners, inverse), corners)
    jacobian = jax.vmap(vjp)(jnp.eye(3, dtype=strain.dtype))[0]  # (strain, corner, axis)

    def energy(strain):
        return _viscoelastic_energy(step, law, strain, anchor)

    stress, tangent = jax.grad(energy)(strain), jax.hessian(energy)(strain)
    material = jnp.einsum("sai,st,tbj->aibj", jacobian, tangent, jacobian)
    shape = jnp.concatenate([-jnp.sum(inverse, axis=0, keepdims=True), inverse])
    carried = blend * _symmetric(stress) + (1 - blend) * _tension(stress)
    geometric = jnp.einsum("as,st,bt,ij->aibj", shape, carried, shape, jnp.eye(3))
    drag = jax.hessian(_drag_energy, argnums=4)(step, face, normal, wind, corners.mean(axis=0))
    return area * (material + geometric) + jnp.einsum("ab,ij->aibj", jnp.full((3, 3), 1 / 9), drag)


def _symmetric(stress: Float[Array, " 3"]) -> Float[Array, "2 2"]:
    """The matrix of a stress (S11, S22, S12)."""
    return jnp.stack([jnp.stack([stress[0], stress[2]]), jnp.stack([stress[2], stress[1]])])


def _tension(stress: Float[Array, " 3"]) -> Float[Array, "2 2"]:
    """The part of a symmetric stress (S11, S22, S12) whose principal values are positive."""
    mean, half = (stress[0] + stress[1]) / 2, (stress[0] - stress[1]) / 2
    radius = jnp.sqrt(half**2 + stress[2] ** 2)
    high, low = jnp.maximum(mean + radius, 0), jnp.maximum(mean - radius, 0)
    slope = (high - low) / jnp.where(radius > 0, 2 * radius, 1)
    deviator = _symmetric(jnp.stack([half, -half, stress[2]]))
    return (high + low) / 2 * jnp.eye(2) + slope * deviator
