"""Displacements of a pull with their derivatives, and what they miss: markers, clamps, load.

The displacement is the network's plus the even stretch between the clamps.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s.environment.contact import friction_dissipation
from r2s.estimation.pinn.network import DisplacementField, Jet, Pairs, T
from r2s.estimation.pinn.pulls import Pull
from r2s.materials.fabric import Fabric

EDGE_NODES = 6  # of Gauss's quadrature along a clamp


def field(
    network: DisplacementField,
    pull: Pull,
    places: Float[Array, "point 2"],
    frames: Int[Array, " point"],
    pairs: Pairs = (),
) -> Jet:
    """Displacements [m] at places (X, Y) [m] in frames, with derivatives.

    `pairs` of inputs are those of the second derivatives.
    """
    jet = network.jet(_inputs(pull, places, frames), pairs)
    share = (places[:, 0] / pull.size[0])[:, None]
    near, far = ([part[frames] for part in clamp] for clamp in (pull.near, pull.far))
    value, rate, acceleration = (n + share * (f - n) for n, f in zip(near, far, strict=True))
    slope, slope_rate = ((f - n) / pull.size[0] for f, n in zip(far[:2], near[:2], strict=True))
    even = {(0, T): slope_rate, (T, T): acceleration}
    added = [even.get(pair, jnp.zeros_like(value)) for pair in pairs]
    first = jet.first + jnp.stack([slope, jnp.zeros_like(slope), rate])
    second = jet.second + jnp.stack(added) if added else jet.second
    return Jet(jet.value + value, first, second)


def displacement(
    network: DisplacementField,
    pull: Pull,
    places: Float[Array, "point 2"],
    frames: Int[Array, " point"],
) -> Float[Array, "point axis"]:
    """Displacements [m], see `field`, without derivatives."""
    share = (places[:, 0] / pull.size[0])[:, None]
    near, far = pull.near.value[frames], pull.far.value[frames]
    return network(_inputs(pull, places, frames)) + near + share * (far - near)


def _inputs(pull: Pull, places, frames) -> Float[Array, "point 3"]:
    return jnp.concatenate([places, pull.times[frames][:, None]], axis=1)


def gradients(jet: Jet) -> Float[Array, "point axis 2"]:
    """Gradients [-] of the displacement in X and Y."""
    return jnp.moveaxis(jet.first[:2], 0, -1)


def load(
    fabric: Fabric,
    pull: Pull,
    velocity: Float[Array, " axis"],
    acceleration: Float[Array, " axis"],
) -> Float[Array, " axis"]:
    """Load [N/m^2] that the stress must balance: inertia, damping and friction, less the weight.

    The friction is that of the cloth solver on a table (`r2s.environment.contact`).
    """
    limit = fabric.friction * fabric.density * pull.normal
    friction = jax.grad(friction_dissipation, argnums=1)(limit, velocity)
    damped = acceleration + fabric.mass_damping * velocity - pull.gravity
    return fabric.density * damped + friction


def marker_residual(network: DisplacementField, pull: Pull) -> Float[Array, "frame marker axis"]:
    """Differences [m] of the network from the markers; zero where they are not seen."""
    number, markers, axes = pull.displacement.shape
    places = jnp.tile(pull.places, (number, 1))
    moved = displacement(network, pull, places, jnp.repeat(jnp.arange(number), markers))
    difference = moved.reshape(number, markers, axes) - pull.displacement
    return jnp.where(pull.seen[..., None], difference, 0)


def clamp_residual(network: DisplacementField, pull: Pull) -> Float[Array, "point axis"]:
    """Differences [m] of the network from both clamps, at nodes along them in every frame."""
    nodes = jnp.asarray((np.polynomial.legendre.leggauss(EDGE_NODES)[0] + 1) / 2, float)
    number = len(pull.times)
    y = jnp.tile(nodes * pull.size[1], 2 * number)
    frames = jnp.repeat(jnp.arange(number), 2 * EDGE_NODES)
    ends = jnp.tile(jnp.repeat(jnp.array([0.0, 1.0], y.dtype), EDGE_NODES), number)
    places = jnp.stack([ends * pull.size[0], y], axis=1)
    clamp = jnp.where(ends[:, None] > 0, pull.far.value[frames], pull.near.value[frames])
    return displacement(network, pull, places, frames) - clamp
