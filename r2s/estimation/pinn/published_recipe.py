"""The paper's recipe, as a preset to compare with (Ru et al. 2025).

Two losses in SI units: markers by Adam at 1e-4, and the equation of motion in small strain by
L-BFGS with steps of 0.1, with the stiffness trainable and a weight of 0.1 that rises by 0.1 every
500 epochs up to 1; 10,000 epochs. No force enters, so nothing fixes the scale of the stiffness:
what comes out is where it started, or what the descent made of it. The paper does not say how the
two optimisers take turns; here each makes a step in every epoch, and a step of L-BFGS after which
the sum of both losses is greater is taken back in the next epoch, with L-BFGS's memory: otherwise
the network saturates within 50 epochs. (Its own loss is not enough: after a thousand epochs it once
fell to zero, in a network that no longer varied.)
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.pinn.batches import summed
from r2s.estimation.pinn.losses import marker_residual, motion_residual
from r2s.estimation.pinn.network import LAYERS, WIDTH, Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import small
from r2s.estimation.pinn.training import Model, Recipe, init, trainable
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import ParameterSpace

EPOCHS = 10_000
ADAM_RATE, LBFGS_RATE = 1e-4, 0.1
MEMORY = 10  # pairs that L-BFGS remembers
WEIGHT, EVERY = 0.1, 500  # of the equation of motion: at first and as a step; epochs between steps
BEGIN = 10.0  # [N/m], all stiffnesses


class Course(NamedTuple):
    """A model, and after every chunk the losses of markers [m^2] and motion [(N/m^2)^2] and the
    fabric's place in its space."""

    model: Model
    data: Float[np.ndarray, " chunk"]
    motion: Float[np.ndarray, " chunk"]
    places: Float[np.ndarray, "chunk dim"]


def weight(epoch: Array) -> Array:
    """Of the equation of motion in an epoch."""
    return jnp.minimum(WEIGHT * (1 + (epoch // EVERY).astype(float)), 1.0)


def plain(pull: Pull) -> Pull:
    """A pull without what the paper does not use: clamps, force, friction."""
    parts = lambda p: (p.near, p.far, p.normal)
    nothing = jax.tree.map(jnp.zeros_like, parts(pull))
    pull = eqx.tree_at(parts, pull, nothing)
    return eqx.tree_at(lambda p: p.force, pull, None, is_leaf=lambda leaf: leaf is None)


def begin(
    space: ParameterSpace, pulls: Pull, place: Float[Array, " dim"], *, key: PRNGKeyArray
) -> Model:
    """An untrained model of stacked pulls, with networks of the paper's size."""
    model = init(space, pulls, Recipe(width=WIDTH, layers=LAYERS), key=key)
    free = jnp.log(place / (1 - place)).astype(model.free.dtype)  # no weak type: compiles once
    return eqx.tree_at(lambda m: m.free, model, free)


def optimisers() -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam, and L-BFGS with fixed steps."""
    return optax.adam(ADAM_RATE), optax.lbfgs(LBFGS_RATE, MEMORY, linesearch=None)


class State(NamedTuple):
    """Between epochs: the weights after a step of L-BFGS that is not judged yet, the states of both
    optimisers, and what the sum of the losses was before that step."""

    ahead: Any
    adam: Any
    lbfgs: Any
    before: Array


def untouched(model: Model) -> State:
    """Before the first epoch."""
    weights = eqx.filter(model, trainable(model))
    adam, lbfgs = optimisers()
    none = jnp.asarray(jnp.inf, model.free.dtype)
    return State(weights, adam.init(weights), lbfgs.init(weights), none)


def losses(model: Model, space: ParameterSpace, pulls: Pull) -> tuple[Array, Array]:
    """Mean squares of the markers' distances [m^2], and of the residual at the markers in every
    frame [(N/m^2)^2]."""
    fabric = space(model.place)

    def of_pull(network, pull):
        number, markers, _ = pull.displacement.shape
        motion = summed((network, fabric), _motion_of_frame, jnp.arange(number), pull)
        return jnp.mean(marker_residual(network, pull) ** 2), motion / (2 * number * markers)

    data, motion = jax.vmap(of_pull)(model.networks, pulls)
    return jnp.mean(data), jnp.mean(motion)


def _motion_of_frame(weights: tuple[Network, Fabric], frame: Array, pull: Pull) -> Array:
    """Sum of squares of the residual [(N/m^2)^2] at the markers in a frame."""
    frames = jnp.full(len(pull.places), frame)
    return jnp.sum(motion_residual(weights[0], pull, weights[1], pull.places, frames, small) ** 2)


@eqx.filter_jit
def run(
    model: Model, state: State, space: ParameterSpace, pulls: Pull, first: Array, epochs: int
) -> tuple[Model, State, tuple[Array, Array]]:
    """Some epochs from number `first` on; the model is without the step that is not judged yet.

    The losses of markers and motion are those of the last epoch that was good, or of the first.
    """
    weights, fixed = eqx.partition(model, trainable(model))
    adam, lbfgs = optimisers()
    whole = lambda weights: eqx.combine(weights, fixed)

    def epoch(carried, number):
        weights, (ahead, of_adam, of_lbfgs, before) = carried
        data, slope = jax.value_and_grad(lambda w: losses(whole(w), space, pulls)[0])(ahead)
        change, adam_after = adam.update(slope, of_adam)
        stepped = eqx.apply_updates(ahead, change)
        share = weight(number)
        physics = lambda w: share * losses(whole(w), space, pulls)[1]
        motion, slope = jax.value_and_grad(physics)(stepped)
        change, lbfgs_after = lbfgs.update(slope, of_lbfgs, stepped)
        moved = eqx.apply_updates(stepped, change)
        good = data + motion <= before
        on = stepped, State(moved, adam_after, lbfgs_after, data + motion)
        back = weights, State(weights, of_adam, lbfgs.init(weights), jnp.full_like(before, jnp.inf))
        carried = jax.tree.map(lambda new, old: jnp.where(good, new, old), on, back)
        return carried, (good, data, motion / share)

    numbers = first + jnp.arange(epochs)
    (weights, state), (good, *values) = jax.lax.scan(epoch, (weights, state), numbers)
    last = jnp.max(jnp.where(good, jnp.arange(epochs), 0))
    return whole(weights), state, (values[0][last], values[1][last])


def train(
    space: ParameterSpace,
    pulls: Pull,
    place: Float[Array, " dim"],
    epochs: int = EPOCHS,
    chunk: int = 100,
    *,
    key: PRNGKeyArray,
) -> Course:
    """Train on stacked pulls, the fabric from a `place` in its space on.

    Does not raise when it diverges: the course shows it.
    """
    pulls = plain(pulls)
    model, course = begin(space, pulls, place, key=key), []
    state = untouched(model)
    for first in range(0, epochs, chunk):
        about = model, state, space, pulls, jnp.asarray(first), min(chunk, epochs - first)
        model, state, (data, motion) = run(*about)
        course.append((float(data), float(motion), np.asarray(model.place)))
    data, motion, places = (np.array(part) for part in zip(*course, strict=True))
    return Course(model, data, motion, places)
