"""Training of networks: Adam, then L-BFGS, on all losses at once, with the stiffness among them.

Both optimisers are optax's. The training goes in chunks of epochs; points are drawn anew for each,
and after each one a checkpoint may be written.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import checkpoint as checkpoints
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

NOISE = (2e-4, 0.01)  # of markers [m], and of the force over its greatest [-]
SHRINK = 10.0  # the last kernel is small at first, since the even stretch is given


class Model(eqx.Module):
    """What is trained: a network for each pull, and the fabric that they share.

    - `networks`: with a leading axis of pulls.
    - `free`: unbounded parameters. Their sigmoid is a place in the space's unit cube, so that C
      stays positive definite and Poisson's ratio within its range.
    """

    networks: Network
    free: Float[Array, "*batch dim"]

    @property
    def place(self) -> Float[Array, "*batch dim"]:
        """Where the fabric lies in its space's unit cube."""
        return jax.nn.sigmoid(self.free)


@dataclass(frozen=True)
class Recipe:
    """How to train.

    - `losses`: `strong_losses` or `r2s.estimation.pinn.weak_form.weak_losses`.
    - `weights`: of the terms, in the order of `Losses`; 0 leaves one out.
    - `strain`: `green` or `small`.
    - `warm_up`, `adam`: epochs of Adam without and with physics.
    - `lbfgs`: iterations of L-BFGS after them.
    - `rate`: of Adam, which falls to a hundredth by a cosine.
    - `fabric_rate`: that of the fabric's parameters, as a multiple.
    - `points`: number of points in each sheet where equations are tested.
    - `redraw`: epochs in a chunk.
    - `width`, `layers`: of the network.
    """

    losses: Callable[..., Losses] = strong_losses
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

    @property
    def adam_chunks(self) -> int:
        """Number of chunks that Adam makes."""
        return -(-(self.warm_up + self.adam) // self.redraw)

    @property
    def chunks(self) -> int:
        """Number of chunks of the whole training."""
        return self.adam_chunks + -(-self.lbfgs // self.redraw)


class Trained(NamedTuple):
    """Trained models, and their course after each chunk; all with a leading axis of fabrics.

    - `losses`: [-]. - `places`: of the fabrics in the space's unit cube.
    """

    model: Model
    losses: Losses
    places: Float[np.ndarray, "fabric chunk dim"]


def init(space: ParameterSpace, pulls: Pull, recipe: Recipe, *, key: PRNGKeyArray) -> Model:
    """An untrained model of stacked pulls, its fabric in the middle of the space."""

    def network(pull: Pull, key: PRNGKeyArray) -> Network:
        high = jnp.concatenate([pull.size, pull.times[-1:]])
        return Network.make(
            jnp.zeros_like(high),
            high,
            jnp.max(jnp.abs(pull.displacement)) / 2,
            width=recipe.width,
            layers=recipe.layers,
            shrink=SHRINK,
            key=key,
        )

    keys = jr.split(key, pulls.angle.shape[0])
    return Model(jax.vmap(network)(pulls, keys), jnp.zeros(space.dim, float))


def trainable(model: Model) -> Any:
    """A tree like the model, true for what is trained: the networks' parameters and the fabric."""
    none = jax.tree.map(lambda _: False, model)
    parts = (none.networks.params, none.free)
    return eqx.tree_at(
        lambda m: (m.networks.params, m.free), none, jax.tree.map(lambda _: True, parts)
    )


def total(
    model: Model,
    space: ParameterSpace,
    pulls: Pull,
    points: Points,
    noise: Array,
    weight,
    recipe: Recipe,
) -> tuple[Array, Losses]:
    """The sum of all losses, those of physics times `weight` [-], and the losses themselves."""
    fabric = space(model.place)

    def of_pull(network: Network, pull: Pull, points: Points) -> Losses:
        greatest = jnp.ones((), float) if pull.force is None else jnp.max(jnp.abs(pull.force))
        scales = scales_of(pull, fabric, noise[0], noise[1] * greatest)
        return recipe.losses(network, pull, fabric, points, scales, recipe.strain)

    each = jax.vmap(of_pull)(model.networks, pulls, points)
    losses = jax.tree.map(jnp.mean, each)
    terms = [w * value for w, value in zip(recipe.weights, losses, strict=True)]
    data, motion, traction, free, clamps = terms
    return data + clamps + weight * (motion + traction + free), losses


def redrawn(
    model: Model, space: ParameterSpace, pulls: Pull, recipe: Recipe, key: PRNGKeyArray
) -> Points:
    """New points for every pull.

    In the strong form half of them are drawn from four times as many, with chances that grow with
    the residual of the equation of motion there.
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
    """State of a training: models, state of Adam, and number of epochs of Adam that are done."""

    model: Model
    state: Any
    epoch: Array


def adam(recipe: Recipe) -> optax.GradientTransformation:
    """Adam with the recipe's rates."""
    epochs = recipe.warm_up + recipe.adam
    return optax.adam(optax.cosine_decay_schedule(recipe.rate, max(epochs, 1), 0.01))


@eqx.filter_jit
def adam_chunk(
    progress: Progress,
    spaces: ParameterSpace,
    pulls: Pull,
    noise: Array,
    recipe: Recipe,
    key: PRNGKeyArray,
) -> tuple[Progress, Losses]:
    """A chunk of epochs of Adam for every fabric, and the losses of the last epoch."""
    which, optimiser = trainable(progress.model), adam(recipe)

    def run(progress: Progress, space: ParameterSpace, pulls: Pull, key: PRNGKeyArray):
        points = redrawn(progress.model, space, pulls, recipe, key)

        def epoch(progress: Progress, _):
            weight = (progress.epoch >= recipe.warm_up).astype(float)
            params, fixed = eqx.partition(progress.model, which)

            def loss(params):
                model = eqx.combine(params, fixed)
                return total(model, space, pulls, points, noise, weight, recipe)

            gradient, losses = jax.grad(loss, has_aux=True)(params)
            change, state = optimiser.update(gradient, progress.state)
            change = eqx.tree_at(
                lambda m: m.free, change, replace_fn=lambda free: recipe.fabric_rate * free
            )
            model = eqx.apply_updates(progress.model, change)
            return Progress(model, state, progress.epoch + 1), losses

        return jax.lax.scan(epoch, progress, None, recipe.redraw)

    keys = jr.split(key, progress.epoch.shape[0])
    progress, losses = jax.vmap(run)(progress, spaces, pulls, keys)
    return progress, jax.tree.map(lambda values: values[:, -1], losses)


@eqx.filter_jit
def lbfgs_chunk(
    progress: Progress,
    spaces: ParameterSpace,
    pulls: Pull,
    noise: Array,
    recipe: Recipe,
    key: PRNGKeyArray,
) -> tuple[Progress, Losses]:
    """A chunk of iterations of L-BFGS with a line search for every fabric, and the last losses.

    It begins without memory: the curvature that it remembered would be of other points.
    """
    which, optimiser = trainable(progress.model), optax.lbfgs()

    def run(model: Model, space: ParameterSpace, pulls: Pull, key: PRNGKeyArray):
        points = redrawn(model, space, pulls, recipe, key)
        params, fixed = eqx.partition(model, which)

        def losses(params):
            model = eqx.combine(params, fixed)
            return total(model, space, pulls, points, noise, 1.0, recipe)

        def loss(params):
            return losses(params)[0]

        value_and_grad = optax.value_and_grad_from_state(loss)

        def iterate(carried, _):
            params, state = carried
            value, gradient = value_and_grad(params, state=state)
            change, state = optimiser.update(
                gradient, state, params, value=value, grad=gradient, value_fn=loss
            )
            return (eqx.apply_updates(params, change), state), None

        begin = params, optimiser.init(params)
        (params, _), _ = jax.lax.scan(iterate, begin, None, recipe.redraw)
        return eqx.combine(params, fixed), losses(params)[1]

    keys = jr.split(key, progress.epoch.shape[0])
    model, losses = jax.vmap(run)(progress.model, spaces, pulls, keys)
    return progress._replace(model=model), losses


def train(
    spaces: ParameterSpace,
    pulls: Pull,
    recipe: Recipe = Recipe(),
    *,
    noise: tuple[float, float] = NOISE,
    report: Callable[[int, Losses], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> Trained:
    """Train a network for each pull of each fabric, and the fabrics, all together.

    - `spaces`, `pulls`: with a leading axis of fabrics; `pulls` have one of pulls after it.
    - `noise`: of the markers [m], and of the force over its greatest [-].
    - `report`: called after every chunk with its number and the losses.
    - `checkpoint`: a file that is written after every chunk, and from which a killed training of
      the same problem goes on.

    Raises `RuntimeError` when a loss is not finite, `ValueError` for a checkpoint of another
    problem.
    """
    key_init, key_chunks = jr.split(key)
    number, weights = pulls.angle.shape[0], jnp.asarray(noise, float)

    def begin(space: ParameterSpace, pulls: Pull, key: PRNGKeyArray) -> Progress:
        model = init(space, pulls, recipe, key=key)
        state = adam(recipe).init(eqx.filter(model, trainable(model)))
        return Progress(model, state, jnp.zeros((), int))

    progress = jax.vmap(begin)(spaces, pulls, jr.split(key_init, number))
    history: list[tuple[Losses, Array]] = []
    run = {"kind": "training of networks"}
    if checkpoint is not None:
        run["run"] = checkpoints.fingerprint(spaces, pulls, weights, _settings(recipe), key)
        progress, history = _resumed(checkpoint, run, progress)
    for chunk in range(len(history), recipe.chunks):
        make = adam_chunk if chunk < recipe.adam_chunks else lbfgs_chunk
        key_chunk = jr.fold_in(key_chunks, chunk)
        progress, losses = make(progress, spaces, pulls, weights, recipe, key_chunk)
        if not all(bool(jnp.isfinite(values).all()) for values in losses):
            raise RuntimeError(f"training diverged in chunk {chunk + 1}: {losses}")
        history.append((losses, progress.model.place))
        if checkpoint is not None:
            arrays = checkpoints.arrays_of((progress, _stacked(history)))
            checkpoints.save(checkpoint, arrays, run)
        if report is not None:
            report(chunk, losses)
    losses, places = jax.tree.map(np.asarray, _stacked(history))
    return Trained(progress.model, losses, places)


def _stacked(history: list[tuple[Losses, Array]]) -> tuple[Losses, Array]:
    """Losses and places with an axis of chunks after that of fabrics."""
    return jax.tree.map(lambda *values: jnp.stack(values, 1), *history)


def _resumed(path: Path, run: dict[str, str], progress: Progress):
    """The state of a training and its history, from a checkpoint if there is one."""
    place = progress.model.place
    likeness = progress, (Losses(place, place, place, place, place), place)
    stored = checkpoints.load(path, run)
    if stored is None:
        return progress, []
    progress, course = checkpoints.tree_from(stored, likeness)
    chunks = range(course[1].shape[1])
    return progress, [jax.tree.map(lambda values, at=at: values[:, at], course) for at in chunks]


def _settings(recipe: Recipe) -> dict[str, Any]:
    """The fields of a recipe, functions by name."""
    values = {field.name: getattr(recipe, field.name) for field in fields(recipe)}
    return {name: getattr(value, "__name__", value) for name, value in values.items()}
