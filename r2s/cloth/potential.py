"""The energy that one implicit step minimises.

With the rate of BDF2 [1/s] the velocity at the end of a step is
v = rate (x - x_anchor) and the acceleration rate (v - v_anchor), both linear in the new positions
x. The new positions are then those that minimise the *incremental potential*

    inertia  m rate^2 / 2 |x - x_anchor - v_anchor / rate|^2
    + stored energy(x) + dissipation(v) / rate

(Ortiz and Stainier 1999; Kane et al. 2000; for contact Li et al. 2020). What has no potential
is lagged: the normals for the drag, and the normal force for the friction, are those at the start
of the step.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.cloth.linear.dissection import Level
from r2s.cloth.linear.pattern import Pattern, add_between, add_elements, assemble
from r2s.cloth.linear.system import Far
from r2s.cloth.self_contact.contacts import (
    Contacts,
    SelfContact,
    contact_energy,
    contact_hessians,
)
from r2s.fabrics.fabric import Fabric
from r2s.geometry.mesh import Mesh
from r2s.laws.bending import BendingLaw, angle_gradient, hinge_angle, unwrapped
from r2s.laws.membrane import MembraneLaw, green_strain
from r2s.laws.plate import PlateLaw
from r2s.units import GRAVITY
from r2s.world import contact
from r2s.world.air import Air
from r2s.world.contact import Table

Positions = Float[Array, "vertex 3"]
Blocks = Float[Array, "block 3 3"]


class IncrementalPotential(eqx.Module):
    """All that a step's potential depends on, beside the new positions.

    - `rate`: of the time-stepping formula, [1/s].
    - `x_anchor`, `v_anchor`: what the formula's velocity [m/s] and acceleration start from.
    - `strain_anchor`, `curvature_anchor`: likewise for the rates of strain [-] and curvature [1/m].
    - `angles`: of the hinges at the start of the step, [rad].
    - `area_normals`: of the faces at the start of the step, [m^2].
    - `friction_limit`: coefficient times normal force at the start of the step, [N].
    - `membrane`, `bending`: the fabric's laws as they stand in this step (`at`), one for each face,
      and for each face or hinge.
    - `wind`: on the faces, [m/s].
    - `layers`, `contacts`: of the sheet with itself; None: it passes through itself.
    """

    mesh: Mesh
    fabric: Fabric
    membrane: MembraneLaw
    bending: BendingLaw | PlateLaw
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
    layers: SelfContact | None = None
    contacts: Contacts | None = None

    @property
    def pattern(self) -> Pattern:
        """The blocks that its Hessian may have."""
        layers = self.layers
        return self.mesh.pattern if layers is None or layers.whole is None else layers.whole.pattern

    @property
    def levels(self) -> tuple[Level, ...]:
        """The order in which the Hessian is eliminated."""
        layers = self.layers
        return self.mesh.levels if layers is None or layers.whole is None else layers.whole.levels


def strains(mesh: Mesh, x: Positions) -> Float[Array, "face 3"]:
    """Green strain (E11, E22, 2 E12) [-] of every face at positions [m]."""
    return jax.vmap(green_strain)(x[mesh.faces], mesh.inverse)


def hinge_angles(mesh: Mesh, x: Positions) -> Float[Array, " hinge"]:
    """Angle [rad] of every hinge at positions [m]."""
    return jax.vmap(hinge_angle)(x[mesh.hinges])


def curvatures(mesh: Mesh, angles: Float[Array, " hinge"]) -> Float[Array, " hinge"]:
    """Curvature theta l / A [1/m] of hinges at their angles [rad], less that at rest."""
    return angles * _widths(mesh) - mesh.rest_curvature


def vertex_mass(mesh: Mesh, fabric: Fabric) -> Float[Array, " vertex"]:
    """Lumped mass [kg] of every vertex."""
    return fabric.density * mesh.vertex_area


def bends(
    mesh: Mesh, law: BendingLaw | PlateLaw, hinges: Float[Array, " hinge"]
) -> Float[Array, "face 3"] | Float[Array, " hinge"]:
    """What a law sees [1/m] of hinges' curvatures: these, or those of faces (k11, k22, 2 k12)."""
    return mesh.patches.curvatures(hinges) if isinstance(law, PlateLaw) else hinges


def bending_laws(mesh: Mesh, law: Any, hinges: Float[Array, " hinge"]) -> Any:
    """The bending law of every face or hinge, as it stands at the curvatures [1/m] of hinges."""
    if isinstance(law, PlateLaw):
        return jax.vmap(law.at)(bends(mesh, law, hinges))
    return jax.vmap(law.at)(mesh.hinge_direction, hinges)


def bending_areas(mesh: Mesh, law: BendingLaw | PlateLaw) -> Float[Array, " element"]:
    """The areas [m^2] on which a law acts: of the faces, or those of the hinges."""
    return mesh.area if isinstance(law, PlateLaw) else mesh.hinge_area


def _viscoelastic(
    energy_density: Callable[[Array], Array], strain: Array, anchor: Array, viscosity: Array
) -> Array:
    """Stored energy and dissipation of one strain: the viscous stress is damping x tangent x rate.

    `viscosity` is damping times rate [-]. The tangent is the law's at the anchor.
    """
    change = strain - anchor
    gradient = jax.grad(energy_density)
    _, tangent_change = jax.jvp(gradient, (anchor,), (change,))
    return energy_density(strain) + viscosity / 2 * jnp.sum(change * tangent_change)


def _element_energy(step: IncrementalPotential, law: Any, strain: Array, anchor: Array):
    return _viscoelastic(law.energy_density, strain, anchor, step.fabric.damping * step.rate)


def _drag_energy(step: IncrementalPotential, face, normal, wind, middle):
    velocity = step.rate * (middle - step.x_anchor[face].mean(axis=0))
    return step.air.dissipation(velocity - wind, normal) / step.rate


def _face_energy(step, corners, face, law, inverse, area, anchor, normal, wind):
    strain = green_strain(corners, inverse)
    drag = _drag_energy(step, face, normal, wind, corners.mean(axis=0))
    return area * _element_energy(step, law, strain, anchor) + drag


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


def _faces(step: IncrementalPotential):
    mesh = step.mesh
    shape = mesh.faces, step.membrane, mesh.inverse, mesh.area
    return *shape, step.strain_anchor, step.area_normals, step.wind


def _bends(step: IncrementalPotential, hinges: Float[Array, " hinge"]):
    see = lambda curvatures: bends(step.mesh, step.bending, curvatures)
    areas = bending_areas(step.mesh, step.bending)
    return areas, step.bending, see(hinges), see(step.curvature_anchor)


def _bend_energy(step, area, law, curvature, anchor):
    return area * _element_energy(step, law, curvature, anchor)


def _bending_energy(step: IncrementalPotential, hinges: Float[Array, " hinge"]):
    return jnp.sum(_over(_bend_energy, step)(*_bends(step, hinges)))


def _vertices(step: IncrementalPotential):
    return step.x_anchor, step.v_anchor, step.mesh.vertex_area, step.friction_limit


def _over(function, step):
    """`function(step, element...)`, for all elements."""
    return jax.vmap(lambda *element: function(step, *element))


def potential(step: IncrementalPotential, x: Positions) -> Float[Array, ""]:
    """The incremental potential [J] at new positions [m]."""
    mesh = step.mesh
    elements = (
        jnp.sum(_over(_face_energy, step)(x[mesh.faces], *_faces(step)))
        + _bending_energy(step, _hinge_curvatures(step, x))
        + jnp.sum(_over(_vertex_energy, step)(x, *_vertices(step)))
    )
    if step.contacts is None:
        return elements
    return elements + contact_energy(step.contacts, *_about_layers(step, x))


def _about_layers(step: IncrementalPotential, x: Positions):
    return step.fabric.thickness, step.rate, x, step.x_anchor


def _hinge_curvatures(step: IncrementalPotential, x: Positions) -> Float[Array, " hinge"]:
    return curvatures(step.mesh, unwrapped(hinge_angles(step.mesh, x), step.angles))


residual = jax.grad(potential, argnums=1)  # [N]; zero where the forces balance


def hessian(
    step: IncrementalPotential, x: Positions, exactness: Float[Array, ""] | float = 1.0
) -> Blocks:
    """Second derivative [N/m] of the potential, as blocks of `step.pattern`, but for `far`.

    At an exactness of 0, a positive definite stand-in, whose Newton steps always descend: it
    leaves out the second derivative of the hinge angle, and the geometric stiffness of compressed
    directions, as is usual for cloth (Choi and Ko 2002). Between 0 and 1, that fraction of these.
    """
    mesh, exactness = step.mesh, jnp.asarray(exactness, x.dtype)
    hinges, patches = _bending_hessians(step, x)
    face = lambda *element: _face_hessian(step, exactness, *element)
    blocks = assemble(
        step.pattern,
        jax.vmap(face)(x[mesh.faces], *_faces(step)),
        hinges,
        _over(jax.hessian(_vertex_energy, argnums=1), step)(x, *_vertices(step)),
        patches,
    )
    turned = lambda: add_elements(blocks, step.pattern.hinges, exactness * _turning(step, x))
    blocks = jax.lax.cond(exactness > 0, turned, lambda: blocks)
    if step.contacts is None or step.layers is None or step.layers.whole is None:
        return blocks
    between = contact_hessians(step.contacts, *_about_layers(step, x))
    return add_between(step.pattern, blocks, step.contacts.stencils, between)


def far(step: IncrementalPotential, x: Positions) -> Far | None:
    """What the second derivative [N/m] of the potential has outside of `step.pattern`."""
    if step.contacts is None or step.layers is None or step.layers.whole is not None:
        return None
    return Far(step.contacts.stencils, contact_hessians(step.contacts, *_about_layers(step, x)))


def _bending_hessians(step, x):
    """Second derivatives [N/m] of the bending energy, but for `_turning`: in hinges, or patches."""
    mesh = step.mesh
    gradients = _widths(mesh)[:, None, None] * jax.vmap(angle_gradient)(x[mesh.hinges])
    bent = _bends(step, _hinge_curvatures(step, x))
    stiffnesses = _over(jax.hessian(_bend_energy, argnums=3), step)(*bent)
    if isinstance(step.bending, PlateLaw):
        gradients = mesh.patches.gradients(gradients)
        return None, jnp.einsum("fiva,fij,fjwb->fvawb", gradients, stiffnesses, gradients)
    return jnp.einsum("h,hai,hbj->haibj", stiffnesses, gradients, gradients), None


def _turning(step, x):
    """What the second derivative [N/m] of the bending energy owes to that of the hinges' angles."""
    moments = jax.grad(_bending_energy, argnums=1)(step, _hinge_curvatures(step, x))
    turns = jax.vmap(jax.jacfwd(angle_gradient))(x[step.mesh.hinges])
    return jnp.einsum("h,haibj->haibj", _widths(step.mesh) * moments, turns)


def _widths(mesh: Mesh) -> Float[Array, " hinge"]:
    """What makes a curvature [1/m] of an angle [rad], [1/m]."""
    return mesh.hinge_length / mesh.hinge_area


def _face_hessian(step, exactness, corners, face, law, inverse, area, anchor, normal, wind):
    # exact with all of the stress, since the Green strain is quadratic in the corners
    strain, vjp = jax.vjp(lambda corners: green_strain(corners, inverse), corners)
    jacobian = jax.vmap(vjp)(jnp.eye(3, dtype=strain.dtype))[0]  # (strain, corner, axis)
    energy = lambda strain: _element_energy(step, law, strain, anchor)
    stress, tangent = jax.grad(energy)(strain), jax.hessian(energy)(strain)
    material = jnp.einsum("sai,st,tbj->aibj", jacobian, tangent, jacobian)
    shape = jnp.concatenate([-jnp.sum(inverse, axis=0, keepdims=True), inverse])
    carried = exactness * _symmetric(stress) + (1 - exactness) * _tension(stress)
    geometric = jnp.einsum("as,st,bt,ij->aibj", shape, carried, shape, jnp.eye(3))
    drag = jax.hessian(lambda middle: _drag_energy(step, face, normal, wind, middle))(
        corners.mean(axis=0)
    )
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
