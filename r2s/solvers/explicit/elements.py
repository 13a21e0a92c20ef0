"""Membrane and bending of a sheet as forces on its vertices, and bounds on their frequencies.

Strains, curvatures and laws are those of `r2s.ImplicitCloth`; here they give forces.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.environment.contact import PRESSURE_STIFFNESS, SLIP_SPEED
from r2s.materials.fabric import Fabric
from r2s.materials.wrinkling import membrane_on_samples, stress_on_samples
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import green_strain
from r2s.mesh.surface import strains, vertex_masses
from r2s.mesh.vectors import Vector

Vertices = Float[Array, "vertex 3"]


def membrane_stress(mesh: Mesh, fabric: Fabric, x: Vertices) -> Float[Array, "sample 3"]:
    """Of all strain samples at positions [m], [N/m]."""
    strain = mesh.samples.strains(x)
    laws = membrane_on_samples(mesh.samples, fabric.membrane, fabric.bending, strain)
    return stress_on_samples(laws, strain).reshape(-1, 3)


def membrane_force(mesh: Mesh, x: Vertices, stress: Float[Array, "sample 3"]) -> Vertices:
    """Forces [N] of stresses [N/m] on the vertices."""
    _, to_forces = jax.vjp(partial(strains, mesh), x)
    return -to_forces(mesh.samples.areas.reshape(-1)[:, None] * stress)[0]


def bending_force(mesh: Mesh, fabric: Fabric, x: Vertices, v: Vertices) -> Vertices:
    """Forces [N] of bending with Kelvin-Voigt viscosity on the vertices."""
    law, areas = fabric.bending, fabric.bending.areas(mesh)
    bends = law.bends(mesh)

    def bend(x: Vertices) -> Array:
        return law.curvatures(mesh, bends.curvatures_at(x))

    bent = law.on_elements(mesh, bends.curvatures_at(x))

    def moments(curvature: Array) -> Array:
        return jax.vmap(lambda law, k: jax.grad(law.energy_density)(k))(bent, curvature)

    curvature, rate = jax.jvp(bend, (x,), (v,))
    moment, viscous = jax.jvp(moments, (curvature,), (rate,))
    _, to_forces = jax.vjp(bend, x)
    areas = areas if curvature.ndim == 1 else areas[:, None]
    return -to_forces(areas * (moment + fabric.damping * viscous))[0]


def membrane_frequency(mesh: Mesh, fabric: Fabric) -> Float[Array, ""]:
    """A bound on the square of the membrane's highest frequency [1/s^2], flat and unstrained.

    The bound is that of the worst element, with its mass in equal parts at its corners (Fried
    1972). A law that stiffens counts as its property `stiffest`, if it has one.
    """
    law = getattr(fabric.membrane, "stiffest", fabric.membrane)
    tangent = _tangent(law.at, law)
    samples = mesh.samples
    count = samples.corners.shape[1]

    def square(corners, gradients, areas):
        rates = jax.vmap(jax.jacfwd(green_strain), in_axes=(None, 0))(corners, gradients)
        rates = rates.reshape(*rates.shape[:2], -1)
        share = areas / jnp.sum(areas)
        stiffness = jnp.einsum("q,qsi,st,qtj->ij", share, rates, tangent, rates)
        return count * jnp.linalg.eigvalsh(stiffness)[-1] / fabric.density

    corners = mesh.lay_flat()[samples.corners]
    return jnp.max(jax.vmap(square)(corners, samples.gradients, samples.areas))


def bending_frequency(mesh: Mesh, fabric: Fabric) -> Float[Array, ""]:
    """A bound on the square of the highest frequency of bending [1/s^2], flat and at rest.

    The bound is that of the worst face or hinge, with the vertices' masses in equal parts among
    the elements that share them.
    """
    mass = vertex_masses(mesh, fabric.density)
    law = fabric.bending
    bends = law.bends(mesh)
    if not bends.vertices.shape[0]:
        return jnp.zeros((), float)
    vertices, areas = law.elements(mesh).vertices, law.areas(mesh)
    rates = law.elements(mesh).gradients(bends.gradients(mesh.lay_flat()))
    count, size = rates.shape[:2]
    unbent = jnp.zeros(bends.vertices.shape[0], mesh.rest.dtype)
    laws, flat = law.on_elements(mesh, unbent), law.curvatures(mesh, unbent)
    tangents = jax.vmap(lambda law, k: jax.hessian(law.energy_density)(k))(laws, flat)
    tangents = tangents.reshape(count, size, size)  # of a hinge it is a number
    sharing = jnp.zeros(mass.shape, float).at[vertices].add(1)
    weight = jnp.sqrt(areas[:, None] * sharing[vertices] / mass[vertices])
    rates = (rates * weight[:, None, :, None]).reshape(*rates.shape[:2], -1)
    return jnp.max(jax.vmap(_largest)(tangents, rates))


def _tangent(at: Callable[[Array], Any], law: Any) -> Float[Array, "3 3"]:
    """The stiffness of a law at zero strain or curvature."""
    zero = jnp.zeros(3, jax.tree.leaves(law)[0].dtype)
    return jax.hessian(at(zero).energy_density)(zero)


def _largest(
    tangent: Float[Array, "strain strain"], rates: Float[Array, "strain coordinate"]
) -> Float[Array, ""]:
    """The largest eigenvalue of rates^T tangent rates."""
    size = jnp.trace(tangent) + jnp.finfo(tangent.dtype).tiny
    root = jnp.linalg.cholesky(tangent + 1e-6 * size * jnp.eye(len(tangent), dtype=tangent.dtype))
    scaled = root.T @ rates
    return jnp.linalg.eigvalsh(scaled @ scaled.T)[-1]


SOLVES = 3  # of Newton's method for the slip, which comes from below, within 1 % of it


def moved_velocity(
    dt: Array,
    force: Vector,
    mass: Array,
    v: Vector,
    height: Array,
    density: Array,
    friction: Array,
    mass_damping: Array,
    gravity: Array,
) -> Vector:
    """Velocities [m/s] at the end of a substep `dt` [s].

    - `force`: all but those below, [N]; `mass`: [kg]; `v`: velocities before, [m/s].
    - `height`: above the place where contact with the table begins, [m].
    - `density` [kg/m^2], `friction` [-], `mass_damping` [1/s]: of the fabric.
    - `gravity`: downwards, [m/s^2].
    """
    braking = 1 / (1 + dt * mass_damping)
    along, across, up = (braking * (u + dt * f / mass) for u, f in zip(v, force, strict=True))
    up = up - braking * dt * gravity
    # depth = free depth - dt^2 PRESSURE_STIFFNESS / density * depth^2
    free = jnp.maximum(-height - dt * up, 0)
    stiff = braking * dt**2 * PRESSURE_STIFFNESS / density
    depth = 2 * free / (1 + jnp.sqrt(1 + 4 * stiff * free))
    pushed = braking * dt * PRESSURE_STIFFNESS / density * depth**2
    # a root that has a derivative where nothing slides
    speed = jnp.sqrt(along**2 + across**2 + jnp.finfo(along.dtype).tiny)
    kept = _kept_slip(speed, friction * pushed)
    return kept * along, kept * across, up + pushed


def _kept_slip(speed: Array, loss: Array) -> Array:
    """The fraction of a sliding speed [m/s] that friction leaves, of which it can take `loss`.

    With r the speed that is left, r + loss r / sqrt(r^2 + SLIP_SPEED^2) = speed.
    """
    left = jnp.maximum(speed - loss, speed * SLIP_SPEED / (SLIP_SPEED + loss))
    for _ in range(SOLVES):
        squared = left**2 + SLIP_SPEED**2
        share = loss / jnp.sqrt(squared)
        off = left * (1 + share) - speed
        left = left - off / (1 + share * SLIP_SPEED**2 / squared)
    return left / speed
