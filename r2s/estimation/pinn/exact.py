"""The network alone, to many digits: on fields without noise, by Levenberg and Marquardt's steps.

The strong form: markers, equation of motion and the measured force at once, with the fabric's place
in its space among the unknowns. On exact fields a descent along gradients leaves the stiffness 10
to 30 % off; these steps find it with the same equations.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.pinn.levenberg_marquardt import Fit, Term, Unknown, least_squares
from r2s.estimation.pinn.losses import (
    EDGE_NODES,
    displacement,
    draw_points,
    field,
    gauss,
    gradients,
    motion_residual,
)
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import Strain, green, nominal_stress
from r2s.estimation.pinn.training import Recipe, init
from r2s.fabrics.parameters import ParameterSpace

INSIDE = 1e-3  # from the ends of the ranges
WIDTH, LAYERS, STEPS, POINTS = 20, 4, 60, 600
PRIOR = 12.0**0.5  # one over the deviation of what is even in 0..1


class About(eqx.Module):
    """What rows of residuals share.

    - `likeness`: a network whose weights are the unknowns. - `marker`: [m]. - `motion`: [N/m^2].
    - `force`: [N]. The latter three are what residuals are divided by. - `strain`: see
      `r2s.estimation.pinn.stress`.
    """

    likeness: Network
    space: ParameterSpace
    pull: Pull
    marker: Float[Array, ""]
    motion: Float[Array, ""]
    force: Float[Array, ""]
    strain: Strain = eqx.field(static=True)


def weights_of(network: Network) -> Float[np.ndarray, " weight"]:
    """The weights and biases of a network as one vector."""
    return np.asarray(ravel_pytree((network.weights, network.biases))[0], np.float64)


def with_weights(likeness: Network, unknown: Unknown) -> Network:
    """A network like another one, whose weights and biases are the first of the unknowns."""
    start, whole = ravel_pytree((likeness.weights, likeness.biases))
    replaced: Any = whole(unknown[: len(start)])
    return eqx.tree_at(lambda n: (n.weights, n.biases), likeness, replaced)


def ranged(place: Float[np.ndarray, " dim"], weight: float = PRIOR) -> Term:
    """What draws the last unknowns, a place in a space, to another one.

    To the middle, with the `weight` [-] that it has, it is the ranges as a flat prior.
    """
    rows = jnp.arange(-len(place), 0), jnp.asarray(place, float)
    return Term(_of_range, jnp.asarray(weight, float), rows)


def _of_range(unknown: Unknown, weight: Array, row) -> Array:
    which, at = row
    return weight * (unknown[which] - at)[None]


def clipped(dim: int):
    """Keeps the last `dim` unknowns, a place in a space, within their ranges."""
    return lambda u: np.append(u[:-dim], np.clip(u[-dim:], INSIDE, 1 - INSIDE))


def fit(
    space: ParameterSpace,
    pull: Pull,
    *,
    marker: float = 1e-6,
    tolerance: float = 1e-3,
    strain: Strain = green,
    steps: int = STEPS,
    points: int = POINTS,
    width: int = WIDTH,
    layers: int = LAYERS,
    key: PRNGKeyArray,
) -> tuple[Float[np.ndarray, " dim"], Fit]:
    """The place in a space of the fabric of one pull by the network alone, and the last descent.

    `marker` is the noise of the markers [m]. Equation of motion and force hold to a `tolerance` [-]
    of the stress, at `points` drawn over sheet and frames. Neither clamps nor free edges count.
    Raises `RuntimeError` when it diverges.
    """
    key_network, key_points = jr.split(key)
    recipe = Recipe(width=width, layers=layers)
    begin = init(space, jax.tree.map(lambda leaf: leaf[None], pull), recipe, key=key_network)
    likeness = jax.tree.map(lambda leaf: leaf[0], begin.networks)
    unknown = np.concatenate([weights_of(likeness), np.full(space.dim, 0.5)])
    about = _about(space, pull, likeness, marker, tolerance, strain)
    frames, markers = (grid.ravel() for grid in np.indices(pull.seen.shape))
    seen = (pull.places[markers], jnp.asarray(frames), pull.displacement.reshape(len(frames), -1))
    drawn = draw_points(pull, points, key=key_points)
    data = Term(_of_marker, about, (*seen, pull.seen.ravel()))
    terms = [data, Term(_of_motion, about, (drawn.inner, drawn.inner_frame))]
    terms.append(ranged(np.full(space.dim, 0.5)))
    if pull.force is not None:
        terms.append(Term(_of_force, about, (jnp.arange(len(pull.times)), pull.force)))
    inside = clipped(space.dim)
    # the motion first, or the fabric runs to an end of its ranges meanwhile
    known = least_squares([data, terms[2]], unknown, steps // 3, inside=inside)
    found = least_squares(terms, known.unknown, steps, inside=inside)
    return found.unknown[-space.dim :], found


def _about(space, pull, likeness, marker: float, tolerance: float, strain: Strain) -> About:
    array = lambda value: jnp.asarray(value, float)
    moved, shorter = jnp.max(jnp.abs(pull.displacement)), jnp.min(pull.size)
    stress = space.middle().membrane.c11 * moved / shorter
    force = stress * pull.size[1] if pull.force is None else jnp.max(jnp.abs(pull.force))
    small = array(tolerance)
    scales = array(marker), small * stress / shorter, small * force
    return About(likeness, space, pull, *scales, strain)


def _of_marker(unknown: Unknown, about: About, row) -> Array:
    place, frame, measured, seen = row
    network = with_weights(about.likeness, unknown)
    moved = displacement(network, about.pull, place[None], frame[None])[0]
    return jnp.where(seen, (moved - measured) / about.marker, 0)


def _of_motion(unknown: Unknown, about: About, row) -> Array:
    place, frame = row
    network = with_weights(about.likeness, unknown)
    fabric = about.space(unknown[-about.space.dim :])
    off = motion_residual(network, about.pull, fabric, place[None], frame[None], about.strain)
    return off[0] / about.motion


def _of_force(unknown: Unknown, about: About, row) -> Array:
    """The traction on the far edge, integrated, against the measured force."""
    frame, measured = row
    pull, fabric = about.pull, about.space(unknown[-about.space.dim :])
    nodes, weights = gauss(EDGE_NODES)
    places = jnp.stack([jnp.broadcast_to(pull.size[0], nodes.shape), nodes * pull.size[1]], axis=1)
    network = with_weights(about.likeness, unknown)
    slopes = gradients(field(network, pull, places, jnp.broadcast_to(frame, nodes.shape)))
    stress = jax.vmap(lambda g: nominal_stress(fabric, pull.angle, g, strain=about.strain))(slopes)
    return (pull.size[1] * weights @ stress[:, 0, :1] - measured) / about.force
