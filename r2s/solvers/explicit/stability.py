"""How long an explicit step may be; a viscosity of the membrane that does not shorten it."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from r2s._util.units import Scalar
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import green_strain
from r2s.mesh.surface import vertex_masses

SAFETY = 0.7  # of the limit at rest: what is stretched or compressed is stiffer
STEPS = 25  # to the longest step of a membrane that relaxes
RELAXATION = 2e-3  # [s]: docs/guide/simulate.md says what motions differ by


class Viscosity(NamedTuple):
    """Of substeps of one length, all dimensionless.

    - `share`: viscous stress over the stress that has not relaxed.
    - `rate`: the fraction of the latter that relaxes in a substep.
    """

    share: Array
    rate: Array

    @classmethod
    def make(cls, damping: Array, relaxation: Array, dt: Array) -> "Viscosity":
        """From times, [s]. Without relaxation it is Kelvin's and Voigt's, a substep behind."""
        return cls(damping / (relaxation + dt), dt / (relaxation + dt))

    def resist(self, stress: Array, relaxed: Array, begun: Array) -> tuple[Array, Array]:
        """Stress with viscosity, and the relaxed stress after the substep, [N/m].

        Where a motion has not `begun`, nothing has changed so far.
        """
        ahead = jnp.where(begun, stress - relaxed, 0)
        return stress + self.share * ahead, stress + (self.rate - 1) * ahead


@eqx.filter_jit
def stable_sheet_step(
    mesh: Mesh,
    fabric: Fabric,
    membrane_damping: Scalar | None = None,
    relaxation: Scalar = RELAXATION,
    others: Sequence[tuple[Scalar, Scalar]] = (),
) -> Float[Array, ""]:
    """The longest step [s] that is stable for a fabric near its rest shape.

    - `membrane_damping`, `relaxation`: as in `ExplicitCloth`, [s].
    - `others`: more parts, as the `squares` of `longest_step`.

    The squares of the highest frequencies of membrane and bending have bounds that add. Table and
    friction do not limit it.
    """
    damping = fabric.damping if membrane_damping is None else jnp.asarray(membrane_damping, float)
    bending = bending_frequency(mesh, fabric), fabric.damping
    membrane, relaxing = membrane_frequency(mesh, fabric), jnp.asarray(relaxation, float)
    return longest_relaxing_step(membrane, damping, relaxing, [bending, *others])


def longest_relaxing_step(
    membrane: Scalar, damping: Scalar, relaxation: Scalar, others: Sequence[tuple[Scalar, Scalar]]
) -> Float[Array, ""]:
    """The longest step [s] where the membrane has this `Viscosity`.

    - `membrane`: square of its highest frequency [1/s^2]; `damping`, `relaxation`: its times, [s].
    - `others`: as the `squares` of `longest_step`.

    The membrane needs d^2 w^2 (1 + 2 damping / (2 relaxation + d)) <= 4 in a step d, at which an
    amplitude changes its sign from step to step.
    """
    step = longest_step([(membrane, jnp.zeros((), float)), *others]) / SAFETY

    def nearer(_, step):  # from above: each at least halves the missing orders of magnitude
        stiffer = membrane * (1 + 2 * damping / (2 * relaxation + step))
        return longest_step([(stiffer, jnp.zeros((), float)), *others]) / SAFETY

    return SAFETY * jax.lax.fori_loop(0, STEPS, nearer, step)


def longest_step(squares: Sequence[tuple[Scalar, Scalar]]) -> Float[Array, ""]:
    """The longest step [s] for parts with a highest frequency and a damping time.

    `squares` are pairs of frequency squared [1/s^2] and stiffness-proportional damping time [s].
    Symplectic Euler with the damping of the step's start needs, for every frequency w,
    dt^2 w^2 + 2 dt damping w^2 <= 4. The result is `SAFETY` times that limit.
    """
    stiff = sum(square for square, _ in squares)
    damped = sum(square * time for square, time in squares)
    return SAFETY * 4 / (damped + jnp.sqrt(damped**2 + 4 * jnp.asarray(stiff, float)))


def check_step(dt: float, longest: Float[Array, ""], material: str) -> None:
    """Raises `ValueError` when a step [s] is longer than the longest, unless that is traced."""
    if isinstance(longest, Tracer):
        return
    limit = float(np.min(np.asarray(longest)))
    if not dt <= limit:
        raise ValueError(
            f"the step is limited by {material} to {limit:.4g} s, got dt = {dt:.4g} s: take a "
            "shorter step, a coarser mesh or grid, a softer or heavier material, or less damping"
        )


def membrane_frequency(mesh: Mesh, fabric: Fabric) -> Float[Array, ""]:
    """A bound on the square of the membrane's highest frequency [1/s^2], flat and unstrained.

    That of the worst element, with its mass in equal parts at its corners (Fried 1972). A law that
    stiffens counts as its property `stiffest`, if it has one.
    """
    law = getattr(fabric.membrane, "stiffest", fabric.membrane)
    zero = jnp.zeros(3, jax.tree.leaves(law)[0].dtype)
    tangent = jax.hessian(law.at(zero).energy_density)(zero)
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

    That of the worst element, with the vertices' masses in equal parts among their elements.
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


def _largest(
    tangent: Float[Array, "strain strain"], rates: Float[Array, "strain coordinate"]
) -> Float[Array, ""]:
    """The largest eigenvalue of rates^T tangent rates."""
    size = jnp.trace(tangent) + jnp.finfo(tangent.dtype).tiny
    root = jnp.linalg.cholesky(tangent + 1e-6 * size * jnp.eye(len(tangent), dtype=tangent.dtype))
    scaled = root.T @ rates
    return jnp.linalg.eigvalsh(scaled @ scaled.T)[-1]
