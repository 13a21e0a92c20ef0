"""Which images are compared, and the triplet loss of where they lie on the map."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from r2s.estimation.physnet.dataset import Data

Images = UInt[np.ndarray, "image down across"]


class Split(NamedTuple):
    """Images in units of `dataset.STEP`, and of each the fabric and the motion."""

    depth: Images
    fabric: Int[np.ndarray, " image"]
    motion: Int[np.ndarray, " image"]


def split(data: Data, held_back: float, needed: int, seed: int) -> tuple[Split, Split]:
    """Images of the fabrics to train with, at least `needed`, and of the share `held_back`.

    Raises `ValueError` when either has too few fabrics for a batch or a triplet.
    """
    count = len(data.places)
    order = np.random.default_rng([seed, 0, 1]).permutation(count)
    number = round(held_back * count)
    if number < 2 or count - number < needed:
        raise ValueError(
            f"{count} fabrics, of which {number} are held back: expected at least 2 of these, and "
            f"{needed} more for a batch"
        )
    unseen = np.isin(data.fabric, order[:number])
    return images_of(data, ~unseen), images_of(data, unseen)


def images_of(data: Data, motions: np.ndarray) -> Split:
    depth = data.depth[motions]
    frames = depth.shape[1]
    fabric = np.repeat(data.fabric[motions], frames)
    motion = np.repeat(np.flatnonzero(motions), frames)
    depth = depth.reshape(-1, *depth.shape[2:])
    seen = (depth > 0).any(axis=(1, 2))
    return Split(depth[seen], fabric[seen], motion[seen])


def triplets(images: Split, number: int, seed: int) -> Int[np.ndarray, "triplet 3"]:
    """Anchor, positive, negative: two motions of one fabric, and another fabric; at any frames."""
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


def all_triplets(points: Float[Array, "fabric image dim"], margin: float) -> Float[Array, ""]:
    """The mean loss of all triplets of a batch."""
    squares, alike, same = _pairs(points)
    loss = jax.nn.relu(squares[:, :, None] - squares[:, None, :] + margin)
    counts = (alike & ~same)[:, :, None] & ~alike[:, None, :]
    return jnp.sum(jnp.where(counts, loss, 0)) / jnp.sum(counts)


def hardest_triplets(points: Float[Array, "fabric image dim"], margin: float) -> Float[Array, ""]:
    """The mean loss of every image with its farthest positive and its nearest negative.

    Of Hermans, Beyer and Leibe 2017, "In defense of the triplet loss".
    """
    squares, alike, _ = _pairs(points)
    farthest = jnp.max(jnp.where(alike, squares, 0), axis=1)
    nearest = jnp.min(jnp.where(alike, jnp.inf, squares), axis=1)
    return jnp.mean(jax.nn.relu(farthest - nearest + margin))


def _pairs(points):
    """Squared distances of all images of a batch; which are of one fabric; which are the same."""
    fabrics, images, dim = points.shape
    flat = points.reshape(-1, dim)
    squares = jnp.sum((flat[:, None] - flat[None]) ** 2, axis=2)
    fabric = jnp.repeat(jnp.arange(fabrics), images)
    return squares, fabric[:, None] == fabric[None], jnp.eye(len(flat), dtype=bool)


def draw(
    images: Split, fabrics: int, count: int, generator: np.random.Generator
) -> Int[np.ndarray, "fabric image"]:
    """A batch: numbers of `count` images of each of some fabrics, of other motions at any frame."""
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
