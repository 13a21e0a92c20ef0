"""The embedding of a grey depth image as a point of the physics similarity map.

The branches of a Siamese network share their weights, so that one function serves for all of them.
It has 5 x 5 convolutions with PReLU and 2 x 2 max-pooling, then fully connected layers.
"""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

KERNEL = 5
SLOPE = 0.25  # initial slope of PReLU


@dataclass(frozen=True)
class Architecture:
    """The sizes of a network.

    - `size`: side of the image, [pixel].
    - `channels`: output channels of the convolutions.
    - `hidden`: widths of the hidden fully connected layers.
    - `dim`: dimensions of the map.

    Raises `ValueError` when the image cannot be halved as often as there are convolutions.
    """

    size: int = 64
    channels: tuple[int, ...] = (32, 64)
    hidden: tuple[int, ...] = (256, 256)
    dim: int = 2

    def __post_init__(self) -> None:
        if self.size < 1 or self.size % 2 ** len(self.channels):
            raise ValueError(
                f"size must be a multiple of {2 ** len(self.channels)} for {len(self.channels)} "
                f"convolutions, found {self.size}"
            )


PAPER = Architecture(size=256)  # of Duan et al. 2022
DEEPER = Architecture(channels=(16, 32, 64, 128), dim=8)  # five times as fast at the same size


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
        keys = iter(jax.random.split(key, len(channels) + len(widths)))
        convolution = partial(eqx.nn.Conv2d, kernel_size=KERNEL, padding=KERNEL // 2)
        slopes = jnp.full(len(architecture.channels) + len(architecture.hidden), SLOPE, float)
        return cls(
            [_he_layer(convolution, a, b, next(keys)) for a, b in pairwise(channels)],
            [_he_layer(eqx.nn.Linear, a, b, next(keys)) for a, b in pairwise(widths)],
            slopes,
            architecture,
        )

    def __call__(self, image: Float[Array, "down across"]) -> Float[Array, " dim"]:
        """The point of an image on the map. Raises `ValueError` for an image of another size."""
        size = self.architecture.size
        if image.shape != (size, size):
            raise ValueError(f"expected an image of {size} x {size} pixels, found {image.shape}")
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
    weight = scale * jax.random.normal(key, weight.shape, weight.dtype)
    return eqx.tree_at(lambda at: (at.weight, at.bias), layer, (weight, 0 * layer.bias))


def _prelu(values: Array, slope: Float[Array, ""]) -> Array:
    return jnp.where(values > 0, values, slope * values)


def _halved(values: Float[Array, "channel down across"]) -> Array:
    """The maximum of each 2 x 2 pixels."""
    channel, down, across = values.shape
    return jnp.max(values.reshape(channel, down // 2, 2, across // 2, 2), axis=(2, 4))
