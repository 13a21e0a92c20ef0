"""Training: Adam, then L-BFGS, on all losses at once, with the stiffness among the unknowns."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.pinn.losses import (
    Losses,
    Points,
    draw_points,
    motion_residual,
    scales_of,
    strong_losses,
)
from r2s.estimation.pinn.network import LAYERS, Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import Strain, green
from r2s.fabrics.parameters import ParameterSpace

LossesOf = Callable[..., Losses]
NOISE = (2e-4, 0.01)  # of markers [m], and of the force over its greatest [-]


class Model(eqx.Module):
    """What is trained: a network for each pull, and the fabric that they share.

    - `networks`: with a leading axis, one a pull.
    - `free`: unbounded; its sigmoid is a place in the space's unit cube, so that no bound is left:
      C stays positive definite, and Poisson's ratio within its range.
    """

    networks: Network
    free: Float[Array, "*batch dim"]

    @property
    def place(self) -> Float[Array, "*batch dim"]:
        """Where the fabric lies in its space."""
        return jax.nn.sigmoid(self.free)


@dataclass(frozen=True)
class Recipe:
    """How to train.

    - `losses`: `strong_losses` or `r2s.estimation.pinn.weak_form.weak_losses`.
    - `weights`: of their terms, in the order of `Losses`; 0 leaves one out.
    - `strain`: `green` or `small`.
    - `warm_up`, `adam`, `lbfgs`: epochs without and with physics by Adam, and iterations.
    - `rate`: of Adam, falling to a hundredth by a cosine. - `fabric_rate`: that of the fabric's
      parameters, as a multiple.
    - `points`: in each sheet, drawn anew every `redraw` epochs, half of them where the equation of
      motion is least fulfilled.
    - `width`, `layers`: of the network.
    """

    losses: LossesOf = strong_losses
    weights: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 1.0)
    strain: Strain = green
    warm_up: int = 500
    adam: int = 1500
    lbfgs: int = 200
    rate: float = 3e-3
    fabric_rate: float = 3.0
    points: int = 200
    redraw: int = 100
    width: int = 32
    layers: int = LAYERS


class Trained(NamedTuple):
    """Models, and their losses [-] and places in the space's cube after each chunk of training.

    All with a leading axis, one a fabric.
    """

    model: Model
    losses: Losses
    places: Float[np.ndarray, "fabric chunk dim"]


def init(space: ParameterSpace, pulls: Pull, recipe: Recipe, *, key: PRNGKeyArray) -> Model:
    """An untrained model of stacked pulls, its fabric in the middle of the space."""
    number = pulls.angle.shape[0]

    def network(pull: Pull, key: PRNGKeyArray) -> Network:
        zero = jnp.zeros((1,), float)
        high = jnp.concatenate([pull.size, pull.times[-1:]])
        low = jnp.concatenate([jnp.zeros_like(pull.size), zero])
        scale = jnp.max(jnp.abs(pull.displacement)) / 2
        axes = pull.displacement.shape[-1]
        about = {"axes": axes, "width": recipe.width, "layers": recipe.layers}
        made = Network.make(low, high, scale, **about, key=key)
        *hidden, last = made.weights  # small, since what goes from clamp to clamp is given
        return eqx.tree_at(lambda n: n.weights, made, (*hidden, last / 10))

    return Model(jax.vmap(network)(pulls, jr.split(key, number)), jnp.zeros(space.dim, float))


def trainable(model: Model) -> Any:
    """True for what is trained of a model: weights, biases and the fabric, not the scaling."""
    none = jax.tree.map(lambda _: False, model)
    parts = lambda m: (m.networks.weights, m.networks.biases, m.free)
    return eqx.tree_at(parts, none, jax.tree.map(lambda _: True, parts(model)))


def total(
    model: Model,
    space: ParameterSpace,
    pulls: Pull,
    points: Points,
    noise: Array,
    weight,
    recipe: Recipe,
) -> tuple[Array, Losses]:
    """The sum of all losses with those of physics times `weight` [-], and the losses themselves."""
    fabric = space(model.place)

    def of_pull(network: Network, pull: Pull, points: Points) -> Losses:
        scales = scales_of(pull, fabric, noise[0], noise[1] * _greatest(pull))
        return recipe.losses(network, pull, fabric, points, scales, recipe.strain)

    each = jax.vmap(of_pull)(model.networks, pulls, points)
    losses = jax.tree.map(jnp.mean, each)
    terms = [w * value for w, value in zip(recipe.weights, losses, strict=True)]
    data, motion, traction, free, clamps = terms
    return data + clamps + weight * (motion + traction + free), losses


def _greatest(pull: Pull) -> Array:
    return jnp.ones((), float) if pull.force is None else jnp.max(jnp.abs(pull.force))


def redrawn(
    model: Model, space: ParameterSpace, pulls: Pull, recipe: Recipe, key: PRNGKeyArray
) -> Points:
    """New points: half of them even, half where the equation of motion is least fulfilled.

    The latter are drawn from four times as many, with chances that rise with the residual.
    """
    fabric = space(model.place)

    def of_pull(network: Network, pull: Pull, key: PRNGKeyArray) -> Points:
        key_pool, key_even, key_pick = jr.split(key, 3)
        even = draw_points(pull, recipe.points, key=key_even)
        if recipe.losses is not strong_losses:
            return even
        pool = draw_points(pull, 4 * recipe.points, key=key_pool)
        off = motion_residual(network, pull, fabric, pool.inner, pool.inner_frame, recipe.strain)
        size = jnp.sqrt(jnp.sum(off**2, axis=1))
        chance = size / jnp.maximum(jnp.sum(size), jnp.finfo(size.dtype).tiny)
        half = recipe.points // 2
        picked = jr.choice(key_pick, len(size), (half,), p=chance)
        return even._replace(
            inner=even.inner.at[:half].set(pool.inner[picked]),
            inner_frame=even.inner_frame.at[:half].set(pool.inner_frame[picked]),
        )

    number = pulls.angle.shape[0]
    return jax.vmap(of_pull)(model.networks, pulls, jr.split(key, number))


class Progress(NamedTuple):
    """Where Adam is: the model, its optimiser, and the number of epochs done."""

    model: Model
    state: Any
    epoch: Array


def adam(recipe: Recipe) -> optax.GradientTransformation:
    """Adam with the recipe's rates."""
    epochs = recipe.warm_up + recipe.adam
    schedule = optax.cosine_decay_schedule(recipe.rate, max(epochs, 1), 0.01)
    return optax.adam(schedule)


@eqx.filter_jit
def adam_chunk(
    progress: Progress,
    spaces: ParameterSpace,
    pulls: Pull,
    noise: Array,
    recipe: Recipe,
    epochs: int,
    key,
) -> tuple[Progress, Losses]:
    """Some epochs of Adam for every fabric, on points drawn anew; the losses of the last one."""
    which, optimiser = trainable(progress.model), adam(recipe)
    faster = lambda change: recipe.fabric_rate * change

    def run(progress: Progress, space: ParameterSpace, pulls: Pull, key: PRNGKeyArray):
        points = redrawn(progress.model, space, pulls, recipe, key)

        def epoch(progress: Progress, _):
            weight = (progress.epoch >= recipe.warm_up).astype(float)
            weights, fixed = eqx.partition(progress.model, which)
            loss = lambda weights: total(
                eqx.combine(weights, fixed), space, pulls, points, noise, weight, recipe
            )
            gradient, losses = jax.grad(loss, has_aux=True)(weights)
            change, state = optimiser.update(gradient, progress.state)
            change = eqx.tree_at(lambda m: m.free, change, replace_fn=faster)
            model = eqx.apply_updates(progress.model, change)
            return Progress(model, state, progress.epoch + 1), losses

        return jax.lax.scan(epoch, progress, None, epochs)

    keys = jr.split(key, progress.epoch.shape[0])
    progress, losses = jax.vmap(run)(progress, spaces, pulls, keys)
    return progress, jax.tree.map(lambda values: values[:, -1], losses)


@eqx.filter_jit
def lbfgs_chunk(
    model: Model,
    spaces: ParameterSpace,
    pulls: Pull,
    noise: Array,
    recipe: Recipe,
    iterations: int,
    key,
) -> tuple[Model, Losses]:
    """Some iterations of L-BFGS for every fabric, with a line search, on points drawn anew.

    It begins without memory: the curvature that it remembered would be of other points.
    """
    which, optimiser = trainable(model), optax.lbfgs()

    def run(model: Model, space: ParameterSpace, pulls: Pull, key: PRNGKeyArray):
        points = redrawn(model, space, pulls, recipe, key)
        weights, fixed = eqx.partition(model, which)
        loss = lambda weights: total(
            eqx.combine(weights, fixed), space, pulls, points, noise, 1.0, recipe
        )
        value_of = lambda weights: loss(weights)[0]
        again = optax.value_and_grad_from_state(value_of)

        def iterate(carried, _):
            weights, state = carried
            value, gradient = again(weights, state=state)
            change, state = optimiser.update(
                gradient, state, weights, value=value, grad=gradient, value_fn=value_of
            )
            return (eqx.apply_updates(weights, change), state), None

        begin = weights, optimiser.init(weights)
        (weights, _), _ = jax.lax.scan(iterate, begin, None, iterations)
        return eqx.combine(weights, fixed), loss(weights)[1]

    return jax.vmap(run)(model, spaces, pulls, jr.split(key, model.free.shape[0]))


def train(
    spaces: ParameterSpace,
    pulls: Pull,
    recipe: Recipe = Recipe(),
    *,
    noise: tuple[float, float] = NOISE,
    report: Callable[[Losses, np.ndarray], None] | None = None,
    key: PRNGKeyArray,
) -> Trained:
    """Train a network for each pull of each fabric, and the fabrics, all together.

    `spaces` and `pulls` have a leading axis of fabrics, `pulls` then one of pulls. `noise`: of
    the markers [m], and of the force over its greatest [-]. `report` is called after every chunk
    with the losses and the places in the spaces. Raises `RuntimeError` when a loss is not finite.
    """
    key_init, key = jr.split(key)
    number = pulls.angle.shape[0]
    begin = lambda space, pulls, key: init(space, pulls, recipe, key=key)
    model = jax.vmap(begin)(spaces, pulls, jr.split(key_init, number))
    weights, _ = eqx.partition(model, trainable(model))
    state = jax.vmap(adam(recipe).init)(weights)
    progress = Progress(model, state, jnp.zeros(number, int))
    about = spaces, pulls, jnp.asarray(noise, float), recipe
    history: list[tuple[Losses, np.ndarray]] = []

    def note(losses: Losses, model: Model) -> None:
        history.append((jax.tree.map(np.asarray, losses), np.asarray(model.place)))
        if not all(np.isfinite(values).all() for values in history[-1][0]):
            raise RuntimeError(f"training diverged in chunk {len(history)}: {history[-1][0]}")
        if report is not None:
            report(*history[-1])

    for chunk in range(adam_chunks(recipe)):
        progress, losses = adam_chunk(progress, *about, recipe.redraw, jr.fold_in(key, chunk))
        note(losses, progress.model)
    model = progress.model
    for chunk in range(chunks(recipe) - adam_chunks(recipe)):
        key_points = jr.fold_in(key, adam_chunks(recipe) + chunk)
        model, losses = lbfgs_chunk(model, *about, recipe.redraw, key_points)
        note(losses, model)
    stack = jax.tree.map(lambda *values: np.stack(values, 1), *(losses for losses, _ in history))
    return Trained(model, stack, np.stack([place for _, place in history], 1))


def adam_chunks(recipe: Recipe) -> int:
    """How many chunks of `redraw` epochs Adam makes."""
    return -(-(recipe.warm_up + recipe.adam) // recipe.redraw)


def chunks(recipe: Recipe) -> int:
    """How many chunks a training has, each of `redraw` epochs or iterations."""
    return adam_chunks(recipe) + -(-recipe.lbfgs // recipe.redraw)
