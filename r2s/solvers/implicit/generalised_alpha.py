"""The generalised-alpha method (Chung and Hulbert 1993): a step's formula in place of BDF2's.

With Newmark's rules for positions and velocities, x' = x + dt v + dt^2 ((1/2 - beta) a + beta a')
and v' = v + dt ((1 - gamma) a + gamma a'), the forces per mass p balance at a time within the step:

    (1 - alpha_m) a' + alpha_m a = (1 - alpha_f) p' + alpha_f p + contact'

All numbers follow from the spectral radius at infinity: what a step leaves of the fastest
vibrations. Contact and friction of the table count in full at the end of the step (as in Bruels,
Acary and Cardona 2014), lest the sheet chatter. Divided by 1 - alpha_f it is the derivative of an
incremental potential as BDF2's, with another inertia and another weight of contact.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.wrinkling import tangents_on_samples
from r2s.mesh.surface import area_normals, vertex_masses
from r2s.solvers.implicit.potential import IncrementalPotential, table_forces

Positions = Float[Array, "vertex 3"]


class Coefficients(NamedTuple):
    """- `mass`, `force`: alpha_m and alpha_f, shares of the step's start in the balance [-].
    - `beta`, `gamma`: Newmark's [-].
    """

    mass: float
    force: float
    beta: float
    gamma: float


def coefficients(spectral_radius: float) -> Coefficients:
    """Those of second order which damp slow motion least, for a spectral radius at infinity [-].

    >>> coefficients(0.0)
    Coefficients(mass=-1.0, force=0.0, beta=1.0, gamma=1.5)
    """
    mass = (2 * spectral_radius - 1) / (spectral_radius + 1)
    force = spectral_radius / (spectral_radius + 1)
    return Coefficients(mass, force, (1 - mass + force) ** 2 / 4, 0.5 - mass + force)


def by_generalised_alpha(
    step: IncrementalPotential, state: Any, dt: Float[Array, ""], spectral_radius: float
) -> IncrementalPotential:
    """The potential of a step `dt` [s] from an `ImplicitState`, in place of BDF2's.

    The drag takes normals, and the viscosity stiffness, that are extrapolated to the end: those
    of the start would make them first order.
    """
    mass, force, beta, gamma = coefficients(spectral_radius)
    rate = jnp.asarray(gamma / (beta * dt), float)
    inertia = (1 - mass) / ((1 - force) * beta * dt**2)
    # of the anchor behind the start: in velocity [s], and in acceleration [s^2]
    lags = dt * (beta / gamma - 1), dt**2 * (beta / gamma - 0.5)
    x_anchor = state.x - lags[0] * state.v - lags[1] * state.a
    kept = (1 - mass) * (1 / (2 * beta) - 1) - mass
    pulled = (1 - mass) / (beta * dt) * state.v + kept * state.a + force * state.pull
    x_free = state.x + pulled / (inertia * (1 - force))
    strain, before = (step.mesh.samples.strains(x) for x in (state.x, state.x_before))
    bends = step.bending.bends(step.mesh)
    return dataclasses.replace(
        step,
        rate=rate,
        inertia=jnp.asarray(inertia, float),
        contact_weight=jnp.asarray(1 / (1 - force), float),
        x_anchor=x_anchor,
        v_anchor=rate * (x_free - x_anchor),
        membrane_tangent=tangents_on_samples(step.membrane, 2 * strain - before),
        strain_anchor=_anchor(step.mesh.samples.strains, state, lags),
        curvature_anchor=bends.curvatures(_anchor(bends.angles, state, lags)),
        area_normals=area_normals(step.mesh, 2 * state.x - state.x_before),
    )


def rates_after(
    step: IncrementalPotential,
    state: Any,
    x: Positions,
    dt: Float[Array, ""],
    spectral_radius: float,
) -> tuple[Positions, Positions, Positions]:
    """Velocities [m/s], accelerations and forces per mass without contact [m/s^2] after a step that
    ended at `x` [m].
    """
    mass, force, beta, gamma = coefficients(spectral_radius)
    ahead = (x - state.x - dt * state.v) / (beta * dt**2)
    a = ahead - (1 / (2 * beta) - 1) * state.a
    v = state.v + dt * ((1 - gamma) * state.a + gamma * a)
    contact = table_forces(step, x) / vertex_masses(step.mesh, step.fabric.density)[:, None]
    balanced = (1 - mass) * a + mass * state.a
    return v, a, (balanced - force * state.pull - contact) / (1 - force)


def _anchor(function: Callable, state: Any, lags: tuple[Array, Array]) -> Array:
    """What the rate of a function of positions is taken from: of its value, as of positions."""

    def rate(x, v):
        return jax.jvp(function, (x,), (v,))

    (now, first), (_, second) = jax.jvp(rate, (state.x, state.v), (state.v, state.a))
    return now - lags[0] * first - lags[1] * second
