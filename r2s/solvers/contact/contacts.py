"""Contacts of a sheet with itself, and the energy of their pressure and friction.

A contact is a plane that two places of the sheet may not cross: its normal, and the weights of
their vertices, are those of the closest points when the two touched at the start of the step, or
at the time of their impact in the step. So a contact is lagged, like friction and drag, and its
energy is convex.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.environment import contact
from r2s.mesh.mesh import Mesh
from r2s.solvers.contact.broad_phase import (
    BVH,
    Pairs,
    all_pairs,
    build_bvh,
    candidate_pairs,
    candidate_pairs_in_tree,
)
from r2s.solvers.contact.proximity import closest_weights, separation, time_of_impact

Positions = Float[Array, "vertex 3"]


WATCHED = 1.5  # thicknesses, up to which places that are close at the start of a step touch
CLOSEST = 0.1  # thicknesses, below which a step may not bring any two places
SMALL = 400  # vertices, up to which every pair is looked at, and a matrix couples all


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

    @classmethod
    def none(cls, capacity: int, dtype: Any) -> "Contacts":
        """An empty list."""
        one, three, four = (jnp.zeros((capacity, *axes), dtype) for axes in ((), (3,), (4,)))
        return cls(jnp.zeros((capacity, 4), int), four, three, one, one, jnp.zeros((), int))

    def appended(self, chosen: Bool[Array, " pair"], *columns: Array) -> "Contacts":
        """With the chosen rows of other stencils to limits, as far as there is room."""
        places = self.count + jnp.cumsum(chosen) - 1
        places = jnp.where(chosen, places, self.area.shape[0])  # out of bounds is dropped
        own = self.stencils, self.weights, self.normals, self.area, self.limit
        stencils, weights, normals, area, limit = (
            column.at[places].set(values, mode="drop")
            for column, values in zip(own, columns, strict=True)
        )
        count = self.count + jnp.sum(chosen)
        return Contacts(stencils, weights, normals, area, limit, count)


def contact_energy(
    contacts: Contacts,
    thickness: Float[Array, ""],
    rate: Float[Array, ""],
    x: Positions,
    x_anchor: Positions,
) -> Float[Array, ""]:
    """Energy [J] of pressure, and dissipation of friction over the rate [1/s], of a step."""

    def one(corners, anchor, weights, *rest):
        apart, before = separation(corners, weights), separation(anchor, weights)
        return _energy_apart(thickness, rate, apart, before, *rest)

    return jnp.sum(jax.vmap(one)(*_elements(contacts, x, x_anchor)))


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


def _energy_apart(thickness, rate, apart, anchor, normal, area, limit):
    depth = jnp.maximum(thickness - apart @ normal, 0)
    velocity = rate * (apart - anchor)
    slip = velocity - (velocity @ normal) * normal
    pressed = area * contact.normal_potential(depth)
    return pressed + contact.friction_dissipation(limit, slip) / rate


class SelfContact(eqx.Module):
    """How contacts of a sheet with itself are found.

    - `search`: the pairs of its vertices and triangles, and of its edges, that may meet; of a large
      mesh, a tree in which to find them.
    - `capacity`: how many contacts a step may have; four times as many pairs may be near each
      other. A step that needs more is NaN.
    """

    search: Pairs | BVH
    capacity: int = eqx.field(static=True)

    @classmethod
    def make(cls, mesh: Mesh, capacity: int | None = None) -> "SelfContact":
        """The search for contacts of a mesh.

        The capacity is by default 512, or 24 for each vertex if that is more: what a sheet that is
        folded flat needs. Up to 400 vertices every pair of places is looked at in each step.
        """
        count, faces = mesh.rest.shape[0], np.asarray(mesh.faces)
        capacity = max(512, 24 * count) if capacity is None else capacity
        if count <= SMALL:
            return cls(all_pairs(faces), capacity)
        return cls(build_bvh(faces, np.asarray(mesh.rest)), capacity)

    def candidates(
        self, start: Positions, end: Positions, reach: Float[Array, ""]
    ) -> tuple[Pairs, Bool[Array, ""]]:
        """The pairs that may come within `reach` [m] in a straight motion; if there are more."""
        # the boxes around neighbouring parts of a flat sheet overlap: 8 pairs for each vertex
        capacity = 4 * self.capacity
        if isinstance(self.search, Pairs):
            return candidate_pairs(self.search, start, end, reach, capacity)
        return candidate_pairs_in_tree(self.search, start, end, reach, capacity, 2 * capacity)


def touching(
    self_contact: SelfContact,
    mesh: Mesh,
    thickness: Float[Array, ""],
    friction: Float[Array, ""],
    x: Positions,
) -> tuple[Contacts, Bool[Array, ""]]:
    """The contacts of places that are close to each other, and whether the capacity sufficed."""
    reach = WATCHED * thickness
    near, overflow = self_contact.candidates(x, x, reach)
    weights, normals, distance = jax.vmap(_plane)(x[near.stencils], near.is_edges)
    area = jnp.mean(mesh.vertex_area[near.stencils], axis=1)
    depth = jnp.maximum(thickness - distance, 0)
    limit = friction * area * contact.pressure(depth)
    is_close = near.is_real & (distance < reach)
    empty = Contacts.none(self_contact.capacity, x.dtype)
    contacts = empty.appended(is_close, near.stencils, weights, normals, area, limit)
    return contacts, ~overflow & (contacts.count <= self_contact.capacity)


def colliding(
    self_contact: SelfContact,
    mesh: Mesh,
    thickness: Float[Array, ""],
    before: Positions,
    after: Positions,
    contacts: Contacts,
) -> tuple[Contacts, Bool[Array, ""], Bool[Array, ""]]:
    """The contacts, with those that the motion from `before` to `after` lacks; whether it lacks
    none; whether the capacity sufficed.
    """
    gap = CLOSEST * thickness
    drift = jnp.mean(after - before, axis=0)  # no pair comes closer by what all have in common
    near, overflow = self_contact.candidates(before, after - drift[None], gap)
    start, end = before[near.stencils], after[near.stencils]
    impact = jax.vmap(time_of_impact, in_axes=(0, 0, 0, None))
    times = jax.lax.stop_gradient(impact(start, end, near.is_edges, gap))
    is_hit = near.is_real & jnp.isfinite(times)
    times = jnp.where(is_hit, times, 0)
    refine = jax.vmap(_refined, in_axes=(0, 0, 0, 0, None))
    at = refine(times, start, end, near.is_edges, gap)[:, None, None]
    weights, normals, _ = jax.vmap(_plane)(start + at * (end - start), near.is_edges)
    area = jnp.mean(mesh.vertex_area[near.stencils], axis=1)
    more = contacts.appended(is_hit, near.stencils, weights, normals, area, jnp.zeros_like(area))
    return more, ~jnp.any(is_hit), ~overflow & (more.count <= self_contact.capacity)


def _refined(time, start, end, is_edges, gap):
    """A time of impact, which is known to 1 % of the gap, made exact by Newton's method.

    Two steps, so that it also has the derivative of the exact time. Not for a pair that was too
    close from the start, nor for one that only grazes.
    """

    def distance(t):
        return _plane(start + t * (end - start), is_edges)[2]

    exact = time
    for _ in range(2):
        error, rate = jax.jvp(distance, (exact,), (jnp.ones_like(exact),))
        approaches = (time > 0) & (rate < -gap)  # else it would take longer than the step
        step = (error - gap) / jnp.where(approaches, rate, 1)
        exact = jnp.where(approaches, jnp.clip(exact - step, 0, 1), exact)
    return exact


def _plane(corners, is_edges):
    """Weights, normal and distance [m] of the closest points of a pair."""
    weights = closest_weights(corners, is_edges)
    between = separation(corners, weights)
    squared = jnp.sum(between**2)
    distance = jnp.sqrt(jnp.where(squared > 0, squared, 1))  # safe where two places coincide
    return weights, between / distance, jnp.where(squared > 0, distance, 0)
