"""The published recipe of the physics-informed network, to compare with (Ru et al. 2025).

Two losses in SI units: markers by Adam at 1e-4, and the equation of motion in small strain by
L-BFGS with steps of 0.1. The stiffness is trained along. The equation of motion has a weight of 0.1
that rises by 0.1 every 500 epochs up to 1, over 10,000 epochs. No force enters, so nothing fixes
the scale of the stiffness.

The paper does not say how the two optimisers take turns. Here each makes a step in every epoch. A
step of L-BFGS after which the sum of both losses is greater is taken back in the next epoch, with
the memory of L-BFGS: otherwise the network saturates within 50 epochs. (The loss of the motion
alone is not enough to judge by: after a thousand epochs it once fell to zero, in a network that no
longer varied.)
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Shaped

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


class Course(NamedTuple):
    """A trained model, and the course of its training after every chunk.

    - `data`, `motion`: losses of markers [m^2] and of the motion [(N/m^2)^2].
    - `places`: of the fabric in its space.
    """

    model: Model
    data: Float[np.ndarray, " chunk"]
    motion: Float[np.ndarray, " chunk"]
    places: Float[np.ndarray, "chunk dim"]


def weight(epoch: Array) -> Array:
    """Weight of the equation of motion in an epoch."""
    return jnp.minimum(WEIGHT * (1 + (epoch // EVERY).astype(float)), 1.0)


def plain(pull: Pull) -> Pull:
    """A pull without what the paper does not use: clamps, force and friction."""
    nothing = jax.tree.map(jnp.zeros_like, (pull.near, pull.far, pull.normal))
    pull = eqx.tree_at(lambda p: (p.near, p.far, p.normal), pull, nothing)
    return eqx.tree_at(lambda p: p.force, pull, None, is_leaf=lambda leaf: leaf is None)


def begin(
    space: ParameterSpace, pulls: Pull, place: Float[Array, " dim"], *, key: PRNGKeyArray
) -> Model:
    """An untrained model of stacked pulls, with networks of the published size."""
    model = init(space, pulls, Recipe(width=WIDTH, layers=LAYERS), key=key)
    free = jnp.log(place / (1 - place)).astype(model.free.dtype)  # no weak type: compiles once
    return eqx.tree_at(lambda m: m.free, model, free)


def optimisers() -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Adam, and L-BFGS with fixed steps."""
    return optax.adam(ADAM_RATE), optax.lbfgs(LBFGS_RATE, MEMORY, linesearch=None)


class State(NamedTuple):
    """What a training carries from epoch to epoch beside the model.

    - `ahead`: parameters after a step of L-BFGS that is not judged yet.
    - `adam`, `lbfgs`: states of the optimisers.
    - `before`: sum of the losses before that step.
    """

    ahead: Any
    adam: Any
    lbfgs: Any
    before: Array


def untouched(model: Model) -> State:
    """The state before the first epoch."""
    params = eqx.filter(model, trainable(model))
    adam, lbfgs = optimisers()
    none = jnp.asarray(jnp.inf, model.free.dtype)
    return State(params, adam.init(params), lbfgs.init(params), none)


def losses(model: Model, space: ParameterSpace, pulls: Pull) -> tuple[Array, Array]:
    """Mean squares of the markers' differences [m^2], and of the residual of the motion at the
    markers in every frame [(N/m^2)^2]."""
    fabric = space(model.place)

    def of_pull(network, pull):
        number, markers, _ = pull.displacement.shape
        motion = summed((network, fabric), _motion_of_frame, jnp.arange(number), pull)
        return jnp.mean(marker_residual(network, pull) ** 2), motion / (2 * number * markers)

    data, motion = jax.vmap(of_pull)(model.networks, pulls)
    return jnp.mean(data), jnp.mean(motion)


def _motion_of_frame(params: tuple[Network, Fabric], frame: Array, pull: Pull) -> Array:
    """Sum of squares of the residual [(N/m^2)^2] at the markers in a frame."""
    frames = jnp.full(len(pull.places), frame)
    return jnp.sum(motion_residual(params[0], pull, params[1], pull.places, frames, small) ** 2)


@eqx.filter_custom_vjp
def summed(
    params: PyTree,
    term: Callable[..., Float[Array, ""]],
    batches: PyTree[Shaped[Array, "batch ..."]],
    shared: Any,
) -> Float[Array, ""]:
    """The sum of `term(params, batch, shared)` over batches, whose gradient is made along with it.

    What a batch needs then stays in the processor's cache: the gradient of the equation of motion
    takes 21 ms instead of 62 for all points at once. Gradients are of `params` alone, which are
    floating point arrays.

    - `batches`: arrays with a leading axis of batches.
    - `shared`: by all batches.
    """
    zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(params)))

    def add(total, batch):
        return total + term(params, batch, shared), None

    return jax.lax.scan(add, zero, batches)[0]


@summed.def_fwd
def _forward(perturbed, params, term, batches, shared):
    del perturbed

    def add(total, batch):
        found = jax.value_and_grad(term)(params, batch, shared)
        return jax.tree.map(jnp.add, total, found), None

    slope = jax.tree.map(jnp.zeros_like, params)
    zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(params)))
    return jax.lax.scan(add, (zero, slope), batches)[0]


@summed.def_bwd
def _backward(slope, cotangent, perturbed, params, term, batches, shared):
    del perturbed, params, term, batches, shared
    return jax.tree.map(lambda leaf: cotangent * leaf, slope)


@eqx.filter_jit
def run(
    model: Model, state: State, space: ParameterSpace, pulls: Pull, first: Array, epochs: int
) -> tuple[Model, State, tuple[Array, Array]]:
    """Some epochs from number `first` on; the model is without the step that is not judged yet.

    The losses of markers and motion are those of the last epoch that was good, or of the first.
    """
    params, fixed = eqx.partition(model, trainable(model))
    adam, lbfgs = optimisers()

    def losses_of(params):
        return losses(eqx.combine(params, fixed), space, pulls)

    def epoch(carried, number):
        params, (ahead, of_adam, of_lbfgs, before) = carried
        data, slope = jax.value_and_grad(lambda p: losses_of(p)[0])(ahead)
        change, adam_after = adam.update(slope, of_adam)
        stepped = eqx.apply_updates(ahead, change)
        share = weight(number)
        motion, slope = jax.value_and_grad(lambda p: share * losses_of(p)[1])(stepped)
        change, lbfgs_after = lbfgs.update(slope, of_lbfgs, stepped)
        moved = eqx.apply_updates(stepped, change)
        good = data + motion <= before
        on = stepped, State(moved, adam_after, lbfgs_after, data + motion)
        back = params, State(params, of_adam, lbfgs.init(params), jnp.full_like(before, jnp.inf))
        carried = jax.tree.map(lambda new, old: jnp.where(good, new, old), on, back)
        return carried, (good, data, motion / share)

    numbers = first + jnp.arange(epochs)
    (params, state), (good, *values) = jax.lax.scan(epoch, (params, state), numbers)
    last = jnp.max(jnp.where(good, jnp.arange(epochs), 0))
    return eqx.combine(params, fixed), state, (values[0][last], values[1][last])


def train(
    space: ParameterSpace,
    pulls: Pull,
    place: Float[Array, " dim"],
    epochs: int = EPOCHS,
    chunk: int = 100,
    *,
    key: PRNGKeyArray,
) -> Course:
    """Train on stacked pulls, with the fabric from a `place` in its space on.

    A training that diverges does not raise: its course shows it.
    """
    pulls = plain(pulls)
    model, course = begin(space, pulls, place, key=key), []
    state = untouched(model)
    for first in range(0, epochs, chunk):
        number = min(chunk, epochs - first)
        model, state, values = run(model, state, space, pulls, jnp.asarray(first), number)
        course.append((float(values[0]), float(values[1]), np.asarray(model.place)))
    data, motion, places = (np.array(part) for part in zip(*course, strict=True))
    return Course(model, data, motion, places)
