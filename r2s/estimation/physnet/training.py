"""The embedding of depth images as points of a physics similarity map, and its training.

The branches of a Siamese network share their weights, so that one function serves for all of them:
5 x 5 convolutions with PReLU and 2 x 2 max-pooling, then fully connected layers.

It is trained with triplets, two images of one fabric in different motions and one of another
fabric, by the loss of Schroff, Kalenichenko and Philbin 2015: squared distances with a margin of 1.
Training and validation have different fabrics.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt

from r2s._util.checks import shown
from r2s._util.files import parse
from r2s.estimation import checkpoint
from r2s.estimation.physnet.dataset import DEPTH_UNIT, Data
from r2s.estimation.physnet.images import Flaws, View, flawed, grey

FORMAT = "r2s-physnet/3"
CHUNK = 256  # images that are embedded at once
KERNEL = 5
SLOPE = 0.25  # initial slope of PReLU


# The network


@dataclass(frozen=True)
class Architecture:
    """- `size`: side of the image, [pixel]; to be halved as often as there are convolutions.
    - `channels`: output channels of the convolutions: five times as fast as the paper's (32, 64).
    - `hidden`: widths of the hidden fully connected layers. - `dim`: dimensions of the map.
    """

    size: int = 64
    channels: tuple[int, ...] = (16, 32, 64, 128)
    hidden: tuple[int, ...] = (256, 256)
    dim: int = 8


class PhysNet(eqx.Module):
    """The embedding of one image. `slopes` are those of the PReLU after each layer but the last."""

    convolutions: list[eqx.nn.Conv2d]
    layers: list[eqx.nn.Linear]
    slopes: Float[Array, " activation"]
    architecture: Architecture = eqx.field(static=True)

    @classmethod
    def make(cls, architecture: Architecture, *, key: PRNGKeyArray) -> "PhysNet":
        """An untrained network."""
        channels = (1, *architecture.channels)
        side = architecture.size // 2 ** len(architecture.channels)
        widths = (channels[-1] * side**2, *architecture.hidden, architecture.dim)
        keys = iter(jr.split(key, len(channels) + len(widths)))
        convolution = partial(eqx.nn.Conv2d, kernel_size=KERNEL, padding=KERNEL // 2)
        slopes = jnp.full(len(architecture.channels) + len(architecture.hidden), SLOPE, float)
        return cls(
            [_he_layer(convolution, a, b, next(keys)) for a, b in pairwise(channels)],
            [_he_layer(eqx.nn.Linear, a, b, next(keys)) for a, b in pairwise(widths)],
            slopes,
            architecture,
        )

    def __call__(self, image: Float[Array, "down across"]) -> Float[Array, " dim"]:
        """The point of an image on the map."""
        slopes = iter(self.slopes)
        values = image[None]
        for convolution in self.convolutions:
            values = _halved(_prelu(convolution(values), next(slopes)))
        values = values.reshape(-1)
        for layer in self.layers[:-1]:
            values = _prelu(layer(values), next(slopes))
        return self.layers[-1](values)


def _he_layer(make, inputs: int, outputs: int, key: PRNGKeyArray):
    """A layer with the normal initial weights of He et al. 2015 and biases of zero."""
    layer = make(inputs, outputs, key=key)
    weight = layer.weight
    scale = jnp.sqrt(2 / (weight.size // outputs)).astype(weight.dtype)
    weight = scale * jr.normal(key, weight.shape, weight.dtype)
    return eqx.tree_at(lambda at: (at.weight, at.bias), layer, (weight, 0 * layer.bias))


def _prelu(values: Array, slope: Float[Array, ""]) -> Array:
    return jnp.where(values > 0, values, slope * values)


def _halved(values: Float[Array, "channel down across"]) -> Array:
    """The maximum of each 2 x 2 pixels."""
    channel, down, across = values.shape
    return jnp.max(values.reshape(channel, down // 2, 2, across // 2, 2), axis=(2, 4))


# Batches and triplets


class Split(NamedTuple):
    """Images in units of `DEPTH_UNIT`, with the fabric and the motion of each."""

    depth: UInt[np.ndarray, "image down across"]
    fabric: Int[np.ndarray, " image"]
    motion: Int[np.ndarray, " image"]


def split(data: Data, validation: float, needed: int, seed: int) -> tuple[Split, Split]:
    """Images of the fabrics for training, and of the share `validation` of the fabrics.

    Raises `ValueError` for fewer than two validation fabrics or `needed` training fabrics.
    """
    count = len(data.places)
    order = np.random.default_rng([seed, 0, 1]).permutation(count)
    number = round(validation * count)
    if number < 2 or count - number < needed:
        raise ValueError(
            f"{count} fabrics, of which {number} are for validation: expected at least 2 of these, "
            f"and {needed} more for a batch"
        )
    is_validation = np.isin(data.fabric, order[:number])
    return _images_of(data, ~is_validation), _images_of(data, is_validation)


def _images_of(data: Data, motions: Bool[np.ndarray, " motion"]) -> Split:
    """All images of some motions that are not empty."""
    depth = data.depth[motions]
    frames = depth.shape[1]
    fabric = np.repeat(data.fabric[motions], frames)
    motion = np.repeat(np.flatnonzero(motions), frames)
    depth = depth.reshape(-1, *depth.shape[2:])
    is_full = (depth > 0).any(axis=(1, 2))
    return Split(depth[is_full], fabric[is_full], motion[is_full])


def batch(
    images: Split, fabrics: int, count: int, generator: np.random.Generator
) -> Int[np.ndarray, "fabric image"]:
    """Indices of `count` images of each of some fabrics, of different motions if possible."""
    rows = []
    for fabric in generator.choice(np.unique(images.fabric), fabrics, replace=False):
        own = np.flatnonzero(images.fabric == fabric)
        motions = np.unique(images.motion[own])
        taken = generator.choice(motions, count, replace=len(motions) < count)
        rows.append([generator.choice(own[images.motion[own] == motion]) for motion in taken])
    return np.array(rows)


def triplets(images: Split, number: int, seed: int) -> Int[np.ndarray, "triplet 3"]:
    """Anchors, positives and negatives: two motions of one fabric, and another; any frames."""
    generator = np.random.default_rng([seed, 2])
    anchor = generator.integers(len(images.fabric), size=number)
    positive, negative = np.empty_like(anchor), np.empty_like(anchor)
    for row, first in enumerate(anchor):
        is_same = images.fabric == images.fabric[first]
        others = np.flatnonzero(is_same & (images.motion != images.motion[first]))
        # without others, only one motion of this fabric did not diverge
        positive[row] = generator.choice(others) if len(others) else first
        negative[row] = generator.choice(np.flatnonzero(~is_same))
    return np.stack([anchor, positive, negative], axis=1)


def triplet_loss(points: Float[Array, "fabric image dim"], margin: float) -> Float[Array, ""]:
    """The mean loss of all triplets of a batch."""
    fabrics, images, dim = points.shape
    flat = points.reshape(-1, dim)
    squares = jnp.sum((flat[:, None] - flat[None]) ** 2, axis=2)
    fabric = jnp.repeat(jnp.arange(fabrics), images)
    is_same = fabric[:, None] == fabric[None]
    loss = jax.nn.relu(squares[:, :, None] - squares[:, None, :] + margin)
    counts = (is_same & ~jnp.eye(len(flat), dtype=bool))[:, :, None] & ~is_same[:, None, :]
    return jnp.sum(jnp.where(counts, loss, 0)) / jnp.sum(counts)


# Training


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


def begin(
    view: View, architecture: Architecture = Architecture(), schedule: Schedule = Schedule()
) -> Training:
    """A training without epochs; `architecture` and `view` have the same size."""
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
    parts = split(data, schedule.validation, schedule.fabrics, schedule.seed)
    while len(training.curve) < schedule.epochs:
        training = epoch(training, *parts)
        if path is not None:
            save(training, path)
        if progress is not None:
            progress(len(training.curve), training.curve[-1])
    return training


def epoch(training: Training, images: Split, validation: Split) -> Training:
    """The training after one more epoch."""
    schedule, number = training.schedule, len(training.curve)
    generator = np.random.default_rng([schedule.seed, number])
    network, optimiser = training.network, training.optimiser
    losses = []
    for step in range(schedule.steps):
        chosen = batch(images, schedule.fabrics, schedule.images, generator)
        key = jr.fold_in(jr.key(schedule.seed), number * schedule.steps + step)
        depth = jnp.asarray(images.depth[chosen])
        network, optimiser, loss = _step(network, optimiser, depth, schedule, training.view, key)
        losses.append(loss)
    loss = float(np.mean([float(value) for value in losses]))
    if not np.isfinite(loss):
        raise FloatingPointError(
            f"the loss is {loss} in epoch {number}: lower the learning rate {schedule.rate:g}"
        )
    row = Row(loss, *validate(network, training.view, validation, schedule))
    return training._replace(network=network, optimiser=optimiser, curve=(*training.curve, row))


def validate(
    network: PhysNet, view: View, images: Split, schedule: Schedule
) -> tuple[float, float]:
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


def _flawed_images(depth, view: View, flaws: Flaws, key) -> Float[Array, "image down across"]:
    def one(depth, key):
        return grey(view, flawed(depth, view, flaws, key))

    return jax.vmap(one)(depth.astype(float) * DEPTH_UNIT, jr.split(key, len(depth)))


@eqx.filter_jit
def _embedded(network: PhysNet, view: View, depth, flaws: Flaws, key):
    return jax.vmap(network)(_flawed_images(depth, view, flaws, key))


@eqx.filter_jit
def _step(network: PhysNet, optimiser, depth, schedule: Schedule, view: View, key):
    fabrics, count = depth.shape[:2]
    images = _flawed_images(depth.reshape(-1, *depth.shape[2:]), view, schedule.flaws, key)

    def loss_of(network):
        points = jax.vmap(network)(images).reshape(fabrics, count, -1)
        return triplet_loss(points, schedule.margin)

    loss, slope = eqx.filter_value_and_grad(loss_of)(network)
    update, optimiser = _adam(schedule).update(slope, optimiser)
    return eqx.apply_updates(network, update), optimiser, loss


# Checkpoints


@dataclass(frozen=True)
class _Header:
    """The settings of a training, as they are in its checkpoint."""

    format: str
    architecture: Architecture
    schedule: Schedule
    view: View
    curve: tuple[tuple[float, float, float], ...]
    data: str


def save(training: Training, path: Path | str) -> None:
    """Write a training to a checkpoint, with its settings."""
    network, _, schedule, view, curve, data = training
    header = _Header(FORMAT, network.architecture, schedule, view, curve, data)
    checkpoint.save(path, checkpoint.arrays_of(_state(training)), asdict(header))


def load(path: Path | str) -> Training:
    """Read a training that `save` wrote.

    Raises `FileNotFoundError`, or `ValueError` that names the file when it is damaged or of another
    format.
    """
    arrays, stored = checkpoint.read(path)
    if stored.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {shown(stored.get('format'))}")
    header = parse(_Header, stored, f"{path}")
    empty = begin(header.view, header.architecture, header.schedule)
    network, optimiser = checkpoint.tree_from(arrays, _state(empty))
    network, curve = eqx.combine(network, empty.network), tuple(Row(*row) for row in header.curve)
    return empty._replace(network=network, optimiser=optimiser, curve=curve, data=header.data)


def _state(training: Training) -> tuple[Any, Any]:
    """All arrays of a training."""
    return eqx.filter(training.network, eqx.is_array), training.optimiser
