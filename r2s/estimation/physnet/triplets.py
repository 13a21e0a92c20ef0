"""Batches and triplets of images, and the triplet loss of their points on the map."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from r2s.estimation.physnet.dataset import Data

Images = UInt[np.ndarray, "image down across"]


class Split(NamedTuple):
    """Images in units of `dataset.DEPTH_UNIT`, with the fabric and the motion of each."""

    depth: Images
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
    unseen = np.isin(data.fabric, order[:number])
    return images_of(data, ~unseen), images_of(data, unseen)


def images_of(data: Data, motions: Bool[np.ndarray, " motion"]) -> Split:
    """All images of some motions that are not empty."""
    depth = data.depth[motions]
    frames = depth.shape[1]
    fabric = np.repeat(data.fabric[motions], frames)
    motion = np.repeat(np.flatnonzero(motions), frames)
    depth = depth.reshape(-1, *depth.shape[2:])
    seen = (depth > 0).any(axis=(1, 2))
    return Split(depth[seen], fabric[seen], motion[seen])


def triplets(images: Split, number: int, seed: int) -> Int[np.ndarray, "triplet 3"]:
    """Anchors, positives and negatives: two motions of one fabric, and another; any frames."""
    generator = np.random.default_rng([seed, 2])
    anchor = generator.integers(len(images.fabric), size=number)
    positive, negative = np.empty_like(anchor), np.empty_like(anchor)
    for row, first in enumerate(anchor):
        alike = images.fabric == images.fabric[first]
        other = np.flatnonzero(alike & (images.motion != images.motion[first]))
        alone = len(other) == 0  # only one motion of this fabric did not diverge
        positive[row] = first if alone else generator.choice(other)
        negative[row] = generator.choice(np.flatnonzero(~alike))
    return np.stack([anchor, positive, negative], axis=1)


def triplet_loss(points: Float[Array, "fabric image dim"], margin: float) -> Float[Array, ""]:
    """The mean loss of all triplets of a batch."""
    fabrics, images, dim = points.shape
    flat = points.reshape(-1, dim)
    squares = jnp.sum((flat[:, None] - flat[None]) ** 2, axis=2)
    fabric = jnp.repeat(jnp.arange(fabrics), images)
    alike = fabric[:, None] == fabric[None]
    loss = jax.nn.relu(squares[:, :, None] - squares[:, None, :] + margin)
    counts = (alike & ~jnp.eye(len(flat), dtype=bool))[:, :, None] & ~alike[:, None, :]
    return jnp.sum(jnp.where(counts, loss, 0)) / jnp.sum(counts)


def draw(
    images: Split, fabrics: int, count: int, generator: np.random.Generator
) -> Int[np.ndarray, "fabric image"]:
    """A batch: indices of `count` images of each fabric, of different motions if possible."""
    numbers = np.unique(images.fabric)
    chosen = generator.choice(numbers, fabrics, replace=False)
    rows = []
    for fabric in chosen:
        own = np.flatnonzero(images.fabric == fabric)
        motions = np.unique(images.motion[own])
        few = len(motions) < count
        taken = generator.choice(motions, count, replace=few)
        rows.append([generator.choice(own[images.motion[own] == motion]) for motion in taken])
    return np.array(rows)
