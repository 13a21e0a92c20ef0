"""The losses of the physics-informed network: markers, equation of motion, edges.

Each is the mean square of a residual over its known magnitude (`Scales`). It is about 1 when the
fit is as good as markers and load cell are, so that no weights need tuning.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from r2s.estimation.pinn.network import STRONG, DisplacementField, Jet, T
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import Strain, divergence, green, nominal_stress
from r2s.fabrics.fabric import Fabric
from r2s.units import Scalar
from r2s.world.contact import friction_dissipation

TOLERANCE = 0.01  # to which equations are to hold, of the stress in the sheet
EDGE_NODES = 6  # of Gauss's quadrature along an edge


class Losses(NamedTuple):
    """Terms of a loss, each [-] once scaled.

    - `data`: distance of the markers.
    - `motion`: residual of the equation of motion.
    - `traction`: of the far clamp against the measured force; 0 without one.
    - `free`: traction on the free edges.
    - `clamps`: displacement at the clamps.
    """

    data: Float[Array, ""]
    motion: Float[Array, ""]
    traction: Float[Array, ""]
    free: Float[Array, ""]
    clamps: Float[Array, ""]


class Scales(NamedTuple):
    """Known magnitudes that residuals are divided by.

    - `marker`, `clamp`: of displacements there, [m].
    - `stress`: [N/m]. `length`: over which the stress changes, [m].
    - `force`: [N].
    """

    marker: Float[Array, ""]
    clamp: Float[Array, ""]
    stress: Float[Array, ""]
    force: Float[Array, ""]
    length: Float[Array, ""]


class Points(NamedTuple):
    """Places (X, Y) [m] and numbers of frames where equations are tested.

    - `inner`, `inner_frame`: in the sheet.
    - `edge`, `edge_frame`: on its free edges.
    """

    inner: Float[Array, "*pull point 2"]
    inner_frame: Int[Array, "*pull point"]
    edge: Float[Array, "*pull side 2"]
    edge_frame: Int[Array, "*pull side"]


def scales_of(pull: Pull, fabric: Fabric, marker: Scalar, force: Scalar) -> Scales:
    """Scales from the noise of markers [m] and force [N], and the stress in the sheet.

    The stress is the measured force over the width. Without a force it is that of the `fabric` as
    it is now, held constant, so that a soft one is not preferred.
    """
    stretch = jnp.max(jnp.abs(pull.displacement)) / pull.size[0]
    stress = jax.lax.stop_gradient(fabric.membrane.c11) * stretch
    if pull.force is not None:
        stress = jnp.max(jnp.abs(pull.force)) / pull.size[1]
    marker, force = jnp.asarray(marker, float), jnp.asarray(force, float)
    return Scales(marker, marker / 5, TOLERANCE * stress, force, jnp.min(pull.size))


def draw_points(pull: Pull, count: int, *, key: PRNGKeyArray) -> Points:
    """Points drawn evenly over a sheet, its free edges and the frames; an eighth on the edges."""
    keys = jr.split(key, 5)
    sides = max(count // 8, 2)
    inner = jr.uniform(keys[0], (count, 2), float) * pull.size[None]
    along = jr.uniform(keys[1], (sides,), float) * pull.size[0]
    across = jr.bernoulli(keys[2], 0.5, (sides,)).astype(float) * pull.size[1]
    edge = jnp.stack([along, across], axis=1)
    inner_frame = jr.randint(keys[3], (count,), 0, len(pull.times), int)
    edge_frame = jr.randint(keys[4], (sides,), 0, len(pull.times), int)
    return Points(inner, inner_frame, edge, edge_frame)


def field(
    network: DisplacementField,
    pull: Pull,
    places: Float[Array, "point 2"],
    frames: Int[Array, " point"],
    pairs: tuple[tuple[int, int], ...] = (),
) -> Jet:
    """Displacements [m] with derivatives: the network's plus the even stretch between the clamps.

    `pairs` of inputs are those of the second derivatives.
    """
    inputs = jnp.concatenate([places, pull.times[frames][:, None]], axis=1)
    jet = network.jet(inputs, pairs)
    share = (places[:, 0] / pull.size[0])[:, None]
    near, far = ([part[frames] for part in clamp] for clamp in (pull.near, pull.far))
    value, rate, acceleration = (n + share * (f - n) for n, f in zip(near, far, strict=True))
    slope, slope_rate = ((f - n) / pull.size[0] for f, n in list(zip(far, near, strict=True))[:2])
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
    inputs = jnp.concatenate([places, pull.times[frames][:, None]], axis=1)
    return network(inputs) + near + share * (far - near)


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

    The friction is that of the cloth solver on a table (`r2s.world.contact`).
    """
    limit = fabric.friction * fabric.density * pull.normal
    friction = jax.grad(friction_dissipation, argnums=1)(limit, velocity)
    damped = acceleration + fabric.mass_damping * velocity - pull.gravity
    return fabric.density * damped + friction


def motion_residual(
    network: DisplacementField, pull: Pull, fabric: Fabric, places, frames, strain: Strain = green
) -> Float[Array, "point axis"]:
    """Residual [N/m^2] of the equation of motion: divergence of the stress less the load."""
    jet = field(network, pull, places, frames, STRONG)
    xx, xy, yy, tt = jet.second
    changes = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], axis=1)

    def residual(gradient, changes, velocity, acceleration):
        pulls = divergence(fabric, pull.angle, gradient, changes, strain)
        return pulls - load(fabric, pull, velocity, acceleration)

    return jax.vmap(residual)(gradients(jet), changes, jet.first[T], tt)


def edge_force(
    network: DisplacementField, pull: Pull, fabric: Fabric, strain: Strain = green
) -> Float[Array, "frame axis"]:
    """Force [N] on the far clamp in every frame: the traction, integrated over the edge."""
    nodes, weights = gauss(EDGE_NODES)
    number = len(pull.times)
    y = jnp.tile(nodes * pull.size[1], number)
    places = jnp.stack([jnp.broadcast_to(pull.size[0], y.shape), y], axis=1)
    jet = field(network, pull, places, jnp.repeat(jnp.arange(number), EDGE_NODES))
    stress = jax.vmap(lambda g: nominal_stress(fabric, pull.angle, g, strain=strain))(
        gradients(jet)
    )
    traction = stress[:, :, 0].reshape(number, EDGE_NODES, -1)
    return pull.size[1] * jnp.einsum("q,tqi->ti", weights, traction)


def marker_residual(network: DisplacementField, pull: Pull) -> Float[Array, "frame marker axis"]:
    """Differences [m] of the network from the markers; zero where they are not seen."""
    number, markers, axes = pull.displacement.shape
    places = jnp.tile(pull.places, (number, 1))
    moved = displacement(network, pull, places, jnp.repeat(jnp.arange(number), markers))
    off = moved.reshape(number, markers, axes) - pull.displacement
    return jnp.where(pull.seen[..., None], off, 0)


def clamp_residual(network: DisplacementField, pull: Pull) -> Float[Array, "point axis"]:
    """Differences [m] of the network from both clamps, at nodes along them in every frame."""
    nodes, _ = gauss(EDGE_NODES)
    number = len(pull.times)
    y = jnp.tile(nodes * pull.size[1], 2 * number)
    frames = jnp.repeat(jnp.arange(number), 2 * EDGE_NODES)
    ends = jnp.tile(jnp.repeat(jnp.array([0.0, 1.0], y.dtype), EDGE_NODES), number)
    places = jnp.stack([ends * pull.size[0], y], axis=1)
    far = jnp.where(ends[:, None] > 0, pull.far.value[frames], pull.near.value[frames])
    return displacement(network, pull, places, frames) - far


def common_losses(network: DisplacementField, pull: Pull, scales: Scales):
    """The losses of markers and clamps, which strong and weak form share."""
    off = marker_residual(network, pull)
    share = jnp.mean(pull.seen, dtype=off.dtype)
    data = jnp.mean((off / scales.marker) ** 2) / share
    return data, jnp.mean((clamp_residual(network, pull) / scales.clamp) ** 2)


def strong_losses(
    network: DisplacementField,
    pull: Pull,
    fabric: Fabric,
    points: Points,
    scales: Scales,
    strain: Strain = green,
) -> Losses:
    """The losses with the equation of motion at `points`, and tractions at the edges."""
    data, clamps = common_losses(network, pull, scales)
    off = motion_residual(network, pull, fabric, points.inner, points.inner_frame, strain)
    motion = jnp.mean((off * scales.length / scales.stress) ** 2)
    traction = jnp.zeros((), data.dtype)
    if pull.force is not None:
        measured = edge_force(network, pull, fabric, strain)[:, 0]
        traction = jnp.mean(((measured - pull.force) / scales.force) ** 2)
    jet = field(network, pull, points.edge, points.edge_frame)
    stress = jax.vmap(lambda g: nominal_stress(fabric, pull.angle, g, strain=strain))(
        gradients(jet)
    )
    free = jnp.mean((stress[:, :, 1] / scales.stress) ** 2)
    return Losses(data, motion, traction, free, clamps)


def gauss(number: int) -> tuple[Float[Array, " node"], Float[Array, " node"]]:
    """Nodes and weights of the Gauss-Legendre quadrature on 0..1."""
    nodes, weights = np.polynomial.legendre.leggauss(number)
    return jnp.asarray((nodes + 1) / 2, float), jnp.asarray(weights / 2, float)
