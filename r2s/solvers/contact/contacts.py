"""Contacts of a sheet with itself, and the energy of their pressure and friction.

A contact is a plane that two places of the sheet may not cross: its normal, and the weights of
their vertices, are those of the closest points when the two touched at the start of the step, or
at the time of their impact in the step. So a contact is lagged, like friction and drag, and its
energy is convex.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r2s.environment import contact
from r2s.solvers.contact.proximity import separation

Positions = Float[Array, "vertex 3"]


class Contacts(eqx.Module):
    """Planes that pairs of places may not cross.

    - `stencils`, `weights`: four vertices each, and their share in the distance [-].
    - `normals`: [-].
    - `area`: on which the pressure acts, [m^2]; 0 where there is no contact.
    - `limit`: of friction, coefficient times normal force at the start of the step, [N].
    - `count`: how many there are.
    """

    stencils: Int[Array, "contact 4"]
    weights: Float[Array, "contact 4"]
    normals: Float[Array, "contact 3"]
    area: Float[Array, " contact"]
    limit: Float[Array, " contact"]
    count: Int[Array, ""]


def contact_energy(
    contacts: Contacts,
    thickness: Float[Array, ""],
    rate: Float[Array, ""],
    x: Positions,
    x_anchor: Positions,
) -> Float[Array, ""]:
    """Energy [J] of pressure, and dissipation of friction over the rate [1/s], of a step."""
    energy = jax.vmap(partial(_pair_energy, thickness, rate))
    return jnp.sum(energy(*_elements(contacts, x, x_anchor)))


def contact_hessians(
    contacts: Contacts,
    thickness: Float[Array, ""],
    rate: Float[Array, ""],
    x: Positions,
    x_anchor: Positions,
) -> Float[Array, "contact 4 3 4 3"]:
    """The second derivative [N/m] of each contact's energy; positive semidefinite."""

    def one(corners, anchor, weights, *rest):
        # the energy depends on the corners through one vector only
        def energy(apart, anchor):
            return _energy_apart(thickness, rate, apart, anchor, *rest)

        second = jax.hessian(energy)(separation(corners, weights), separation(anchor, weights))
        return jnp.einsum("a,ij,b->aibj", weights, second, weights)

    return jax.vmap(one)(*_elements(contacts, x, x_anchor))


def _elements(contacts: Contacts, x: Positions, x_anchor: Positions):
    places = x[contacts.stencils], x_anchor[contacts.stencils]
    return *places, contacts.weights, contacts.normals, contacts.area, contacts.limit


def _pair_energy(thickness, rate, corners, anchor, weights, *rest):
    apart, from_ = separation(corners, weights), separation(anchor, weights)
    return _energy_apart(thickness, rate, apart, from_, *rest)


def _energy_apart(thickness, rate, apart, anchor, normal, area, limit):
    depth = jnp.maximum(thickness - apart @ normal, 0)
    velocity = rate * (apart - anchor)
    slip = velocity - (velocity @ normal) * normal
    pressed = area * contact.normal_potential(depth)
    return pressed + contact.friction_dissipation(limit, slip) / rate
