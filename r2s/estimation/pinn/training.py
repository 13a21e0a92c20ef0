"""Training of networks by Adam on all losses at once, with the stiffness among the parameters.

Each loss is the mean square of a residual over its known magnitude. It is about 1 when the fit is
as good as markers and load cell are, so that no weights need tuning. The frames in which the weak
form is tested are drawn anew for each chunk of epochs, after which a checkpoint may be written.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from r2s.estimation import checkpoint as checkpoints
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.weak_form import (
    clamp_residual,
    end_value,
    kinematics,
    marker_residual,
    virtual_fields,
    virtual_work,
)
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace

NOISE = (2e-4, 0.01)  # of markers [m], and of the force over its greatest [-]
TOLERANCE = 0.01  # of the virtual work, over that of the stress in the sheet
CLAMP = 0.2  # error of the displacement at the clamps, over the noise of the markers
SHRINK = 10.0  # the last kernel is small at first, since the even stretch is given
RATE, LAST_RATE = 3e-3, 0.01  # of Adam; where its cosine ends, as a multiple
FABRIC_RATE = 3.0  # that of the fabric's parameters, as a multiple
FRAMES = 25  # in which the weak form is tested
DEGREES, NODES = (3, 4), 8  # of its virtual displacements and their quadrature


class Recipe(NamedTuple):
    """- `warm_up`, `adam`: epochs without and with physics. Few: the fit needs a motion to begin
      with, and its accelerations, no more.
    - `chunk`: epochs for which frames are drawn. - `width`, `layers`: of the network.
    """

    warm_up: int = 200
    adam: int = 200
    chunk: int = 100
    width: int = 32
    layers: int = 7


class Model(eqx.Module):
    """What is trained: a network for each pull, and the fabric that they share.

    - `networks`: with a leading axis of pulls.
    - `free`: unbounded parameters. Their sigmoid is a place in the space's unit cube, so that C
      stays positive definite and Poisson's ratio within its range.
    """

    networks: Network
    free: Float[Array, " dim"]

    @property
    def place(self) -> Float[Array, " dim"]:
        """Where the fabric lies in its space's unit cube."""
        return jax.nn.sigmoid(self.free)


class Trained(NamedTuple):
    """A trained model, and after each chunk the loss of the markers [-] and the fabric's place."""

    model: Model
    losses: Float[np.ndarray, " chunk"]
    places: Float[np.ndarray, "chunk dim"]


class Losses(NamedTuple):
    """Terms of a loss, each [-]: distance of the markers (`data`), displacement at the clamps,
    virtual work in displacements that vanish there, and force on the far clamp (0 without one)."""

    data: Float[Array, "*pull"]
    clamps: Float[Array, "*pull"]
    work: Float[Array, "*pull"]
    force: Float[Array, "*pull"]


class Progress(NamedTuple):
    """State of a training: model, state of Adam, and number of epochs that are done."""

    model: Model
    state: Any
    epoch: Int[Array, ""]


def init(
    space: ParameterSpace, pulls: Pull, width: int, layers: int, *, key: PRNGKeyArray
) -> Model:
    """An untrained model of stacked pulls, its fabric in the middle of the space."""

    def network(pull: Pull, key: PRNGKeyArray) -> Network:
        high = jnp.concatenate([pull.size, pull.times[-1:]])
        scale = jnp.max(jnp.abs(pull.displacement)) / 2
        size: dict[str, Any] = {"width": width, "layers": layers, "shrink": SHRINK}
        return Network.make(high, scale, **size, key=key)

    keys = jr.split(key, pulls.angle.shape[0])
    return Model(jax.vmap(network)(pulls, keys), jnp.zeros(space.dim, float))


def losses_of(network: Network, pull: Pull, fabric: Fabric, frames: Int[Array, " frame"]) -> Losses:
    """The losses of one pull, with the weak form in some frames.

    The work counts beside that of the measured force over the width; without a force, of the stress
    of the `fabric` as it is now, held constant, so that a soft one is not preferred.
    """
    marker, force_noise = NOISE
    residual = marker_residual(network, pull) / marker
    data = jnp.mean(residual**2) / jnp.mean(pull.seen, dtype=residual.dtype)
    clamps = jnp.mean((clamp_residual(network, pull) / (CLAMP * marker)) ** 2)
    virtual = virtual_fields(DEGREES, NODES)
    work = virtual_work(fabric, pull, virtual, kinematics(network, pull, virtual, frames))
    stretch = jnp.max(jnp.abs(pull.displacement)) / pull.size[0]
    stress = jax.lax.stop_gradient(fabric.membrane.c11) * stretch
    force_loss = jnp.zeros((), data.dtype)
    if pull.force is not None:
        greatest = jnp.max(jnp.abs(pull.force))
        stress = greatest / pull.size[1]
        difference = work[:, -1, 0] / end_value(virtual) - pull.force[frames]
        force_loss = jnp.mean((difference / (force_noise * greatest)) ** 2)
    balance = work[:, :-1] / (TOLERANCE * stress * jnp.max(pull.size))
    return Losses(data, clamps, jnp.mean(balance**2), force_loss)


def adam(recipe: Recipe) -> optax.GradientTransformation:
    """Adam, whose rate falls by a cosine."""
    epochs = max(recipe.warm_up + recipe.adam, 1)
    return optax.adam(optax.cosine_decay_schedule(RATE, epochs, LAST_RATE))


@eqx.filter_jit
def train_chunk(
    progress: Progress, space: ParameterSpace, pulls: Pull, recipe: Recipe, key: PRNGKeyArray
) -> tuple[Progress, Losses]:
    """A chunk of epochs, and the losses of the last one."""
    number, count = pulls.times.shape
    frames = jr.randint(key, (number, FRAMES), 0, count, int)

    def total(model: Model, weight: Array) -> tuple[Array, Losses]:
        fabric = space(model.place)
        of_pulls = jax.vmap(lambda network, pull, at: losses_of(network, pull, fabric, at))
        losses = jax.tree.map(jnp.mean, of_pulls(model.networks, pulls, frames))
        return losses.data + losses.clamps + weight * (losses.work + losses.force), losses

    def epoch(progress: Progress, _):
        model, state, done = progress
        weight = (done >= recipe.warm_up).astype(float)  # of the physics
        gradient, losses = jax.grad(total, has_aux=True)(model, weight)
        change, state = adam(recipe).update(gradient, state)
        change = eqx.tree_at(lambda m: m.free, change, replace_fn=lambda free: FABRIC_RATE * free)
        return Progress(eqx.apply_updates(model, change), state, done + 1), losses

    progress, losses = jax.lax.scan(epoch, progress, None, recipe.chunk)
    return progress, jax.tree.map(lambda values: values[-1], losses)


def train(
    space: ParameterSpace,
    pulls: Pull,
    recipe: Recipe,
    *,
    report: Callable[[int, float], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> Trained:
    """Train a network for each of some stacked pulls, and their fabric, together.

    After every chunk `report` is called with its number and the loss of the markers [m^2], and a
    `checkpoint` is written, from which a killed training of the same problem continues. Raises
    `RuntimeError` when a loss is not finite, `ValueError` for a checkpoint of another problem.
    """
    key_init, key_chunks = jr.split(key)
    model: Any = init(space, pulls, recipe.width, recipe.layers, key=key_init)
    progress = Progress(model, adam(recipe).init(model), jnp.zeros((), int))
    losses, places = np.zeros(0), np.zeros((0, space.dim))
    run = {"kind": "training of networks"}
    if checkpoint is not None:
        run["run"] = checkpoints.fingerprint(space, pulls, recipe, key)
        if (stored := checkpoints.load(checkpoint, run)) is not None:
            progress, losses, places = checkpoints.tree_from(stored, (progress, losses, places))
    for chunk in range(len(losses), -(-(recipe.warm_up + recipe.adam) // recipe.chunk)):
        key_chunk = jr.fold_in(key_chunks, chunk)
        progress, now = train_chunk(progress, space, pulls, recipe, key_chunk)
        if not np.isfinite(now).all():
            raise RuntimeError(f"training diverged in chunk {chunk + 1}: {now}")
        losses = np.append(losses, now.data)
        places = np.concatenate([places, np.asarray(progress.model.place)[None]])
        if checkpoint is not None:
            checkpoints.save(checkpoint, checkpoints.arrays_of((progress, losses, places)), run)
        if report is not None:
            report(chunk, float(now.data) * NOISE[0] ** 2)
    return Trained(progress.model, np.asarray(losses), np.asarray(places))
