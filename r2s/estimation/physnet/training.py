"""Training of the embedding with triplets: two images of one fabric in different motions, and one
of another fabric.

The loss is that of Schroff, Kalenichenko and Philbin 2015: squared distances with a margin of 1.
Training and validation have different fabrics.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Float

from r2s.estimation import checkpoint
from r2s.estimation.physnet.dataset import DEPTH_UNIT, Data
from r2s.estimation.physnet.network import DEEPER, Architecture, PhysNet
from r2s.estimation.physnet.preprocess import Flaws, flawed, grey
from r2s.estimation.physnet.triplets import Split, draw, split, triplet_loss, triplets
from r2s.estimation.physnet.views import View

FORMAT = "r2s-physnet/3"
CHUNK = 256  # images that are embedded at once


@dataclass(frozen=True)
class Schedule:
    """The settings of a training.

    - `epochs`, `steps`: number of epochs, and of steps in each.
    - `fabrics`, `images`: fabrics in a batch, and images of each, from different motions.
    - `rate`, `decay`, `decay_every`: Adam's learning rate, times `decay` every so many epochs.
    - `margin`: squared distance by which another fabric is to be farther away.
    - `validation`: share of the fabrics for validation.
    - `triplets`: number of triplets for validation.
    - `flaws`: errors of the images, in training and validation.
    """

    epochs: int = 9
    steps: int = 80
    fabrics: int = 24
    images: int = 4
    rate: float = 1e-3
    decay: float = 0.1
    decay_every: int = 5
    margin: float = 1.0
    validation: float = 0.15
    triplets: int = 4000
    flaws: Flaws = Flaws()
    seed: int = 0


class Row(NamedTuple):
    """The results of an epoch: mean training loss, validation loss, triplet accuracy."""

    loss: float
    validation_loss: float
    accuracy: float


class Training(NamedTuple):
    """The state of a training. With the data it determines the next epoch.

    - `data`: what the data show, such as "lifting on cloth"; "" where a file does not say.
    """

    network: PhysNet
    optimiser: Any
    schedule: Schedule
    view: View
    curve: tuple[Row, ...]
    data: str = ""


def begin(view: View, architecture: Architecture = DEEPER, schedule: Schedule | None = None):
    """A training without epochs. Raises `ValueError` when network and view differ in size."""
    schedule = Schedule() if schedule is None else schedule
    if architecture.size != view.size:
        raise ValueError(
            f"the network takes images of {architecture.size} pixels, the data have {view.size}"
        )
    network = PhysNet.make(architecture, key=jr.key(schedule.seed))
    optimiser = _adam(schedule).init(eqx.filter(network, eqx.is_inexact_array))
    return Training(network, optimiser, schedule, view, ())


def train(
    training: Training,
    data: Data,
    path: Path | str | None = None,
    progress: Callable[[int, Row], None] | None = None,
) -> Training:
    """The training after the rest of its epochs; saved to `path` after each.

    Raises `FloatingPointError` when the loss is not finite.
    """
    schedule = training.schedule
    taught, validation = split(data, schedule.validation, schedule.fabrics, schedule.seed)
    while len(training.curve) < schedule.epochs:
        training = epoch(training, taught, validation)
        if path is not None:
            save(training, path)
        if progress is not None:
            progress(len(training.curve), training.curve[-1])
    return training


def epoch(training: Training, taught: Split, validation: Split) -> Training:
    """The training after one more epoch."""
    schedule, number = training.schedule, len(training.curve)
    generator = np.random.default_rng([schedule.seed, number])
    network, optimiser = training.network, training.optimiser
    losses = []
    for step in range(schedule.steps):
        chosen = draw(taught, schedule.fabrics, schedule.images, generator)
        key = jr.fold_in(jr.key(schedule.seed), number * schedule.steps + step)
        depth = jnp.asarray(taught.depth[chosen])
        network, optimiser, loss = _step(network, optimiser, depth, schedule, training.view, key)
        losses.append(loss)
    loss = float(np.mean([float(value) for value in losses]))
    if not np.isfinite(loss):
        raise FloatingPointError(
            f"the loss is {loss} in epoch {number}: lower the learning rate {schedule.rate:g}"
        )
    row = Row(loss, *judge(network, training.view, validation, schedule))
    return training._replace(network=network, optimiser=optimiser, curve=(*training.curve, row))


def judge(network: PhysNet, view: View, images: Split, schedule: Schedule) -> tuple[float, float]:
    """The mean loss of triplets, and the share of them in which the positive is nearer."""
    parts = []
    for start in range(0, len(images.depth), CHUNK):
        some = images.depth[start : start + CHUNK]
        padded = np.zeros((CHUNK, *some.shape[1:]), some.dtype)  # so that it compiles once
        padded[: len(some)] = some
        key = jr.fold_in(jr.key(schedule.seed), start)
        embedded = _embedded(network, view, jnp.asarray(padded), schedule.flaws, key)
        parts.append(np.asarray(embedded)[: len(some)])
    points = np.concatenate(parts)
    anchor, positive, negative = points[triplets(images, schedule.triplets, schedule.seed).T]
    near, far = (((anchor - other) ** 2).sum(axis=1) for other in (positive, negative))
    loss = np.maximum(near - far + schedule.margin, 0).mean()
    return float(loss), float((near < far).mean())


def _adam(schedule: Schedule) -> optax.GradientTransformation:
    every = schedule.decay_every * schedule.steps
    rate = optax.exponential_decay(schedule.rate, every, schedule.decay, staircase=True)
    return optax.adam(rate)


def _shown(depth, view: View, flaws: Flaws, key) -> Float[Array, "image down across"]:
    def one(depth, key):
        return grey(view, flawed(depth, view, flaws, key))

    return jax.vmap(one)(depth.astype(float) * DEPTH_UNIT, jr.split(key, len(depth)))


@eqx.filter_jit
def _embedded(network: PhysNet, view: View, depth, flaws: Flaws, key):
    return jax.vmap(network)(_shown(depth, view, flaws, key))


@eqx.filter_jit
def _step(network: PhysNet, optimiser, depth, schedule: Schedule, view: View, key):
    fabrics, count = depth.shape[:2]
    images = _shown(depth.reshape(-1, *depth.shape[2:]), view, schedule.flaws, key)

    def loss_of(network):
        points = jax.vmap(network)(images).reshape(fabrics, count, -1)
        return triplet_loss(points, schedule.margin)

    loss, slope = eqx.filter_value_and_grad(loss_of)(network)
    update, optimiser = _adam(schedule).update(slope, optimiser)
    return eqx.apply_updates(network, update), optimiser, loss


def save(training: Training, path: Path | str) -> None:
    """Write a training to a checkpoint, with its settings."""
    header = {
        "format": FORMAT,
        "architecture": asdict(training.network.architecture),
        "schedule": asdict(training.schedule) | {"flaws": training.schedule.flaws._asdict()},
        "view": asdict(training.view),
        "curve": training.curve,
        "data": training.data,
    }
    checkpoint.save(path, checkpoint.arrays_of(_state(training)), header)


def load(path: Path | str) -> Training:
    """Read a training that `save` wrote.

    Raises `FileNotFoundError`, or `ValueError` that names the file when it is damaged or of another
    format.
    """
    arrays, header = checkpoint.read(path)
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {header.get('format')}")
    schedule = header["schedule"] | {"flaws": Flaws(**header["schedule"]["flaws"])}
    architecture = Architecture(**_tuples(header["architecture"]))
    empty = begin(View(**_tuples(header["view"])), architecture, Schedule(**schedule))
    network, optimiser = checkpoint.tree_from(arrays, _state(empty))
    network = eqx.combine(network, empty.network)
    curve = tuple(Row(*row) for row in header["curve"])
    return empty._replace(network=network, optimiser=optimiser, curve=curve, data=header["data"])


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    """The values with tuples in place of JSON's lists."""
    return {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}


def _state(training: Training) -> tuple[Any, Any]:
    """All arrays of a training."""
    return eqx.filter(training.network, eqx.is_array), training.optimiser
