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
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.arrays import once
from r2s.environment import contact
from r2s.environment.air import Air
from r2s.environment.contact import Table
from r2s.materials.bending import BendingLaw
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import MembraneLaw, stress_and_tangent
from r2s.materials.wrinkling import (
    Columns,
    given_way,
    search,
    split,
    stress_on_samples,
    with_wrinkles,
)
from r2s.mesh.bends import unwrapped
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import on_samples
from r2s.solvers.contact.contacts import Contacts, contact_energy, contact_hessians
from r2s.solvers.implicit.system import Elimination, Far, add_elements, assemble

Positions = Float[Array, "vertex 3"]
Blocks = Float[Array, "block 3 3"]


class IncrementalPotential(eqx.Module):
    """All that a step's potential depends on, beside the new positions.

    - `membrane`, `bending`: the fabric's laws as they stand in this step, one for each element.
    - `membrane_tangent`: stiffness [N/m] of every sample at `strain_anchor`, for its viscosity.
    - `rate`: of the time-stepping formula, [1/s]; `inertia`: its square, or nearly, [1/s^2].
    - `contact_weight`: of contact and friction on the table among the forces, [-].
    - `x_anchor`, `v_anchor`: what the formula's velocity [m/s] and acceleration start from.
    - `strain_anchor`, `curvature_anchor`: likewise for the rates of strain [-] and of the bends'
      curvature [1/m].
    - `angles`: of the bends at the start of the step, [rad].
    - `area_normals`: of the elements at the start of the step, [m^2].
    - `friction_limit`: coefficient times normal force at the start of the step, [N].
    - `wind`: on the elements, [m/s]. `gravity`: downwards, [m/s^2].
    - `elimination`: how its Hessian is eliminated.
    - `contacts`: of the sheet with itself; None: it passes through itself.
    """

    mesh: Mesh
    fabric: Fabric
    membrane: MembraneLaw
    membrane_tangent: Float[Array, "element sample 3 3"]
    bending: BendingLaw
    air: Air
    table: Table
    rate: Float[Array, ""]
    inertia: Float[Array, ""]
    contact_weight: Float[Array, ""]
    x_anchor: Positions
    v_anchor: Positions
    strain_anchor: Float[Array, "element sample 3"]
    curvature_anchor: Float[Array, " bend"]
    angles: Float[Array, " bend"]
    area_normals: Float[Array, "element 3"]
    friction_limit: Float[Array, " vertex"]
    wind: Float[Array, "element 3"]
    gravity: Float[Array, ""]
    elimination: Elimination
    contacts: Contacts | None = None


def potential(step: IncrementalPotential, x: Positions, wrinkles: Any = None) -> Float[Array, ""]:
    """The incremental potential [J] at new positions [m].

    With `wrinkles` that were searched for at `x` its derivative is right, but no second one.
    """
    samples = step.mesh.samples
    membrane = on_samples(partial(_sample_energy, step), *_samples(step, x, wrinkles))
    return jnp.sum(samples.areas * membrane) + _others(step, x)


def _others(step: IncrementalPotential, x: Positions) -> Float[Array, ""]:
    """The potential [J] without that of the membrane."""
    total = jnp.sum(_map(_drag_energy, step, *_drag(step, x)))
    total += _bending_energy(step, _curvatures(step, x))
    total += jnp.sum(_map(_vertex_energy, step, *_vertices(step, x)))
    if step.contacts is None:
        return total
    return total + contact_energy(step.contacts, step.fabric.thickness, step.rate, x, step.x_anchor)


@jax.jit  # so that it is traced once for all uses in a motion and its derivatives
def residual(step: IncrementalPotential, x: Positions) -> Positions:
    """The derivative [N] of the potential; zero where the forces on every vertex balance.

    The membrane's is by its stress in closed form, whose derivatives are cheaper.
    """
    samples = step.mesh.samples
    strain, to_forces = jax.vjp(samples.strains, x)
    change = strain - step.strain_anchor
    viscous = jnp.sum(step.membrane_tangent * change[:, :, None], axis=3)
    stress = stress_on_samples(step.membrane, strain) + step.fabric.damping * step.rate * viscous
    return to_forces(samples.areas[:, :, None] * stress)[0] + jax.grad(_others, argnums=1)(step, x)


def table_forces(step: IncrementalPotential, x: Positions) -> Positions:
    """Pressure and friction [N] of the table on the vertices, at the end of a step, unweighted."""
    area, limit = step.mesh.vertex_area, step.friction_limit
    slopes = _map(jax.grad(_table_energy, argnums=1), step, x, step.x_anchor, area, limit)
    return -slopes


def find_wrinkles(step: IncrementalPotential, x: Positions, near: Any = None) -> Any:
    """The wrinkles of all samples at positions [m], without derivatives; None where there are none.

    Those of positions that are `near` make the search shorter.
    """
    return search(step.membrane, step.mesh.samples.strains(x), near)


@jax.jit
def hessian(
    step: IncrementalPotential,
    x: Positions,
    hessian_blend: Float[Array, ""] | float = 1.0,
    wrinkles: Any = None,
) -> Blocks:
    """Second derivative [N/m] of the potential, as blocks of its pattern, but for `far_couplings`.

    With a `hessian_blend` of 0 it is a positive definite stand-in, whose Newton steps always
    descend: it leaves out the second derivative of the bends' angles, and the geometric stiffness
    of compressed directions, as is usual for cloth (Choi and Ko 2002). Between 0 and 1 it has that
    fraction of these. `wrinkles` are those that were found at `x`; None: they are searched for.
    """
    if wrinkles is None:
        wrinkles = find_wrinkles(step, x)
    pattern, blend = step.elimination.pattern, jnp.asarray(hessian_blend, x.dtype)
    samples = _membrane_hessians(step, x, blend, wrinkles) + _drag_hessians(step, x)
    vertices = _map(jax.hessian(_vertex_energy, argnums=1), step, *_vertices(step, x))
    bending = {step.bending.element: _bending_hessians(step, x)}
    blocks = assemble(pattern, vertices, samples=samples, **bending)
    bends = pattern.slots[step.bending.bend]
    blocks = jax.lax.cond(
        blend > 0,
        lambda: add_elements(blocks, bends, blend * _angle_hessians(step, x)),
        lambda: blocks,
    )
    if step.contacts is None or not step.elimination.couples_all:
        return blocks
    stencils = step.contacts.stencils  # between any vertices: the pattern is full
    slots = stencils[:, :, None] * len(x) + stencils[:, None, :]
    return add_elements(blocks, slots, _contact_hessians(step, x))


def far_couplings(step: IncrementalPotential, x: Positions) -> Far | None:
    """What the second derivative [N/m] of the potential has outside of its pattern."""
    if step.contacts is None or step.elimination.couples_all:
        return None
    return Far(step.contacts.stencils, _contact_hessians(step, x))


def _map(function: Callable, step: IncrementalPotential, *elements: Any) -> Any:
    """`function(step, *element)` of all elements."""
    return jax.vmap(lambda *element: function(step, *element))(*elements)


def _samples(step: IncrementalPotential, x: Positions, wrinkles: Any = None):
    strain, law = step.mesh.samples.strains(x), with_wrinkles(step.membrane, wrinkles)
    return law, step.membrane_tangent, strain, step.strain_anchor


def _drag(step: IncrementalPotential, x: Positions):
    corners = step.mesh.samples.corners
    return x[corners].mean(axis=1), corners, step.area_normals, step.wind


def _vertices(step: IncrementalPotential, x: Positions):
    return x, step.x_anchor, step.v_anchor, step.mesh.vertex_area, step.friction_limit


def _viscous_energy(step, change: Array, stress_change: Array) -> Array:
    """Dissipation of one element in a step, per area [J/m^2], by its change since the anchor."""
    return step.fabric.damping * step.rate / 2 * jnp.sum(change * stress_change)


def _sample_energy(step, law: MembraneLaw, tangent: Array, strain: Array, anchor: Array) -> Array:
    """Stored energy and dissipation of the membrane, per area [J/m^2]."""
    change = strain - anchor
    viscous = _viscous_energy(step, change, jnp.sum(tangent * change[None], axis=1))
    return law.energy_density(strain) + viscous


def _drag_energy(step, middle, corners, normal, wind):
    velocity = step.rate * (middle - step.x_anchor[corners].mean(axis=0))
    return step.air.dissipation(velocity - wind, normal) / step.rate


def _vertex_energy(step, x, x_anchor, v_anchor, area, limit):
    mass = step.fabric.density * area
    offset = x - x_anchor - v_anchor / step.rate
    velocity = step.rate * (x - x_anchor)
    drag = mass * step.fabric.mass_damping / 2 * jnp.sum(velocity**2)
    return (
        mass * step.inertia / 2 * jnp.sum(offset**2)
        + mass * step.gravity * x[2]
        + step.contact_weight * _table_energy(step, x, x_anchor, area, limit)
        + drag / step.rate
    )


def _table_energy(step, x, x_anchor, area, limit):
    depth = step.table.depth(x, step.fabric.thickness)
    slip = step.rate * (x - x_anchor)[:2]
    friction = contact.friction_dissipation(limit, slip)
    return area * contact.normal_potential(depth) + friction / step.rate


def _curvatures(step: IncrementalPotential, x: Positions) -> Float[Array, " bend"]:
    bends = step.bending.bends(step.mesh)
    return bends.curvatures(unwrapped(bends.angles(x), step.angles))


def _bending_elements(step: IncrementalPotential, bends: Float[Array, " bend"]):
    mesh, law = step.mesh, step.bending
    before = law.curvatures(mesh, step.curvature_anchor)
    return law.areas(mesh), law, law.curvatures(mesh, bends), before


def _element_bending_energy(step, area, law, curvature, anchor):
    change = curvature - anchor
    _, moment_change = jax.jvp(jax.grad(law.energy_density), (anchor,), (change,))
    return area * (law.energy_density(curvature) + _viscous_energy(step, change, moment_change))


def _bending_energy(step: IncrementalPotential, bends: Float[Array, " bend"]):
    return jnp.sum(_map(_element_bending_energy, step, *_bending_elements(step, bends)))


def _bending_hessians(step: IncrementalPotential, x: Positions):
    """Second derivatives [N/m] of the bending energy of each element, but for `_angle_hessians`."""
    mesh, law = step.mesh, step.bending
    gradients = law.elements(mesh).gradients(law.bends(mesh).gradients(x))
    elements = _bending_elements(step, _curvatures(step, x))
    stiffness = _map(jax.hessian(_element_bending_energy, argnums=3), step, *elements)
    if stiffness.ndim == 1:  # of a scalar curvature
        return jnp.einsum("e,eva,ewb->evawb", stiffness, gradients[:, 0], gradients[:, 0])
    return jnp.einsum("eiva,eij,ejwb->evawb", gradients, stiffness, gradients)


def _angle_hessians(step: IncrementalPotential, x: Positions):
    """What the second derivative [N/m] of the bending energy owes to that of the bends' angles."""
    moments = jax.grad(_bending_energy, argnums=1)(step, _curvatures(step, x))
    return step.bending.bends(step.mesh).second_derivatives(x, moments)


def _contact_hessians(step: IncrementalPotential, x: Positions):
    assert step.contacts is not None
    return contact_hessians(step.contacts, step.fabric.thickness, step.rate, x, step.x_anchor)


def _membrane_hessians(
    step: IncrementalPotential, x: Positions, blend: Float[Array, ""], wrinkles: Any
):
    """Second derivatives [N/m] of each element's membrane energy in its corners.

    Exact with all of the stress, since the Green strain is quadratic in the corners. Elements are
    the last axis, for vectorised loops.
    """
    samples = step.mesh.samples
    law, tangent_before, strain, anchor = _samples(step, x, wrinkles)
    taut, wrinkled = split(law)
    parts = on_samples(partial(_stress_and_tangent, step), taut, tangent_before, strain, anchor)
    stress, tangent = jnp.moveaxis(parts[0], -1, 0), jnp.moveaxis(parts[1], (-2, -1), (0, 1))
    if wrinkled is not None:
        relief, softening = given_way(wrinkled, strain)
        stress, tangent = stress + relief, tangent + softening
    stress, tangent = samples.areas[None] * stress, samples.areas[None, None] * tangent
    carried = blend * stress + (1 - blend) * _tension(stress)
    corners = jnp.moveaxis(x[samples.corners], 0, -1)
    corners = corners - corners[:1]  # places in the world would cost precision
    slopes = jnp.moveaxis(samples.gradients, 0, -1)
    shares = [
        _from_sample(corners, slopes[q], carried[:, :, q], tangent[:, :, :, q])
        for q in range(len(slopes))
    ]
    return jnp.moveaxis(sum(shares[1:], start=shares[0]), -1, 0)


def _from_sample(
    corners: Float[Array, "corner 3 element"],
    slopes: Float[Array, "corner 2 element"],
    stress: Float[Array, "3 element"],
    tangent: Float[Array, "3 3 element"],
) -> Float[Array, "corner 3 corner 3 element"]:
    """The share of one sample of every element, whose stress and tangent include its area."""

    def rates_and_rows(corners, slopes, tangent):
        along, across = slopes[:, :1], slopes[:, 1:]
        warp, weft = (jnp.sum(slope * corners, axis=0)[None] for slope in (along, across))
        rates = along * warp, across * weft, along * weft + across * warp  # of strain, in corners
        rows = [sum(tangent[i, j][None, None] * rates[j] for j in range(3)) for i in range(3)]
        return rates, rows

    total = _geometric(slopes, stress)
    for rate, row in zip(*once(rates_and_rows, corners, slopes, tangent), strict=True):
        total = total + rate[:, :, None, None] * row[None, None]
    return total


def _geometric(slopes, stress) -> Float[Array, "corner 3 corner 3 element"]:
    """The geometric stiffness of one sample of every element."""
    one, two = slopes[:, None, 0], slopes[:, None, 1]
    other_one, other_two = slopes[None, :, 0], slopes[None, :, 1]
    first, second, shear = stress[:, None, None]
    by_corners = one * (first * other_one + shear * other_two)
    by_corners += two * (shear * other_one + second * other_two)
    return by_corners[:, None, :, None] * jnp.eye(3, dtype=stress.dtype)[None, :, None, :, None]


def _stress_and_tangent(step, law: MembraneLaw, tangent_before: Array, strain: Array, anchor):
    """First and second derivative [N/m] of `_sample_energy` in the strain."""
    stress, tangent = stress_and_tangent(law, strain)
    viscous = step.fabric.damping * step.rate * tangent_before
    return stress + jnp.sum(viscous * (strain - anchor)[None], axis=1), tangent + viscous


def _drag_hessians(step: IncrementalPotential, x: Positions):
    """Second derivatives [N/m] of each element's drag in its corners, equal in all of them."""
    of_middle = _map(jax.hessian(_drag_energy, argnums=1), step, *_drag(step, x))
    count = step.mesh.samples.corners.shape[1]
    shape = len(of_middle), count, 3, count, 3
    return jnp.broadcast_to(of_middle[:, None, :, None], shape) / count**2


def _tension(stress: Columns) -> Columns:
    """The part of a symmetric stress (S11, S22, S12) whose principal values are positive."""
    mean, half = (stress[0] + stress[1]) / 2, (stress[0] - stress[1]) / 2
    radius = jnp.sqrt(half**2 + stress[2] ** 2)
    high, low = jnp.maximum(mean + radius, 0), jnp.maximum(mean - radius, 0)
    slope = (high - low) / jnp.where(radius > 0, 2 * radius, 1)
    middle = (high + low) / 2
    return jnp.stack([middle + slope * half, middle - slope * half, slope * stress[2]])
