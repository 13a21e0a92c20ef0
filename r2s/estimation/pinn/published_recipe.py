"""The published recipe of the physics-informed network, to compare with (Ru et al. 2025).

Two losses in SI units: markers by Adam at 1e-4, and the equation of motion in small strain by
L-BFGS with steps of 0.1. The stiffness is trained along. The equation of motion has a weight of 0.1
that rises by 0.1 every 500 epochs up to 1, over 10,000 epochs. No force enters, so nothing fixes
the scale of the stiffness.

The paper does not say how the two optimisers take turns. Here each makes a step in every epoch. A
step of L-BFGS after which the sum of both losses is greater is taken back in the next epoch, with
the memory of L-BFGS: otherwise the network saturates within 50 epochs.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.pinn.network import Network, T, X, Y
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.training import Model, Trained, init
from r2s.estimation.pinn.weak_form import (
    field,
    load,
    marker_residual,
    nominal_stress,
    small_strain,
)
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace

EPOCHS = 10_000
WIDTH, LAYERS = 50, 7  # six hidden layers and the last one
ADAM, LBFGS = optax.adam(1e-4), optax.lbfgs(0.1, memory_size=10, linesearch=None)
WEIGHT, EVERY = 0.1, 500  # of the equation of motion: at first and as a step; epochs between steps


class State(NamedTuple):
    """- `model`: without the last step of L-BFGS. - `ahead`: with it.
    - `adam`, `lbfgs`: states of the optimisers. - `before`: sum of the losses before that step.
    """

    model: Any
    ahead: Any
    adam: Any
    lbfgs: Any
    before: Float[Array, ""]


def train(
    space: ParameterSpace,
    pulls: Pull,
    epochs: int = EPOCHS,
    chunk: int = 100,
    *,
    key: PRNGKeyArray,
) -> Trained:
    """Train on stacked pulls, with the fabric from the middle of its space on; losses are [m^2].

    A training that diverges does not raise: its losses show it.
    """
    pulls = without_force(pulls)
    state, losses, places = begin(space, pulls, key=key), [], []
    for first in range(0, epochs, chunk):
        number = min(chunk, epochs - first)
        state, loss = run(state, space, pulls, jnp.asarray(first), number)
        losses.append(float(loss))
        places.append(np.asarray(state.model.place))
    return Trained(state.model, np.array(losses), np.array(places))


def without_force(pull: Pull) -> Pull:
    """A pull without what the paper does not use: clamps, force and friction."""
    nothing = jax.tree.map(jnp.zeros_like, (pull.near, pull.far, pull.normal))
    pull = eqx.tree_at(lambda p: (p.near, p.far, p.normal), pull, nothing)
    return eqx.tree_at(lambda p: p.force, pull, None, is_leaf=lambda leaf: leaf is None)


def begin(space: ParameterSpace, pulls: Pull, *, key: PRNGKeyArray) -> State:
    """The state before the first epoch, in the middle of the space; `pulls` are stacked."""
    model: Any = init(space, pulls, WIDTH, LAYERS, key=key)
    none = jnp.asarray(jnp.inf, model.free.dtype)
    return State(model, model, ADAM.init(model), LBFGS.init(model), none)


@eqx.filter_jit
def run(
    state: State, space: ParameterSpace, pulls: Pull, first: Array, epochs: int
) -> tuple[State, Float[Array, ""]]:
    """Some epochs from number `first` on, and the loss of the markers [m^2] in the last epoch after
    which no step was taken back, or in the first."""

    def epoch(state: State, number: Array):
        model, ahead, of_adam, of_lbfgs, before = state
        data, slope = jax.value_and_grad(marker_loss)(ahead, pulls)
        change, of_adam_next = ADAM.update(slope, of_adam)
        stepped = eqx.apply_updates(ahead, change)
        both = motion_loss(stepped, space, pulls)
        motion, slope = jax.tree.map(lambda x: weight(number) * x, both)
        change, of_lbfgs_next = LBFGS.update(slope, of_lbfgs, stepped)
        moved = eqx.apply_updates(stepped, change)
        is_good = data + motion <= before
        on = State(stepped, moved, of_adam_next, of_lbfgs_next, data + motion)
        back = State(model, model, of_adam, LBFGS.init(model), jnp.full_like(before, jnp.inf))
        state = jax.tree.map(lambda new, old: jnp.where(is_good, new, old), on, back)
        return state, (is_good, data)

    state, (is_good, data) = jax.lax.scan(epoch, state, first + jnp.arange(epochs))
    return state, data[jnp.max(jnp.where(is_good, jnp.arange(epochs), 0))]


def weight(epoch: Array) -> Array:
    """Weight of the equation of motion in an epoch."""
    return jnp.minimum(WEIGHT * (1 + (epoch // EVERY).astype(float)), 1.0)


def marker_loss(model: Model, pulls: Pull) -> Float[Array, ""]:
    """Mean square of the markers' differences [m^2]."""
    return jnp.mean(jax.vmap(marker_residual)(model.networks, pulls) ** 2)


def motion_loss(model: Model, space: ParameterSpace, pulls: Pull) -> tuple[Float[Array, ""], Model]:
    """Mean square of the residual of the motion at the markers in every frame [(N/m^2)^2], and its
    gradient.

    Both are summed frame by frame, so that what a frame needs stays in the processor's cache, which
    is three times as fast.
    """
    number = pulls.times.shape[1]

    def of_frame(model, frame):
        def residual(network, pull):
            frames = jnp.full(len(pull.places), frame)
            return motion_residual(network, pull, space(model.place), pull.places, frames)

        return jnp.mean(jax.vmap(residual)(model.networks, pulls) ** 2) / number

    def add(sums, frame):
        return jax.tree.map(jnp.add, sums, jax.value_and_grad(of_frame)(model, frame)), None

    nothing = jax.tree.map(jnp.zeros_like, (model.free[0], model))
    return jax.lax.scan(add, nothing, jnp.arange(number))[0]


def motion_residual(
    network: Network, pull: Pull, fabric: Fabric, places, frames
) -> Float[Array, "point axis"]:
    """Residual [N/m^2] of the equation of motion in small strain: divergence of the stress less
    the load. Damping of the stress is left out, as it would need third derivatives."""
    jet = field(network, pull, places, frames, ((X, X), (X, Y), (Y, Y), (T, T)))
    xx, xy, yy, tt = jet.second
    changes = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], axis=1)

    def stress(gradient):
        return nominal_stress(fabric, pull.angle, gradient, strain=small_strain)

    def residual(gradient, changes, velocity, acceleration):
        by_x, by_y = (jax.jvp(stress, (gradient,), (change,))[1] for change in changes)
        return by_x[:, 0] + by_y[:, 1] - load(fabric, pull, velocity, acceleration)

    return jax.vmap(residual)(jet.gradient, changes, jet.first[T], tt)
