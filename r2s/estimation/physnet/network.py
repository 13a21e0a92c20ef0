"""The embedding: a grey depth image to a point of the physics similarity map.

Two networks with the same weights, the branches of a Siamese network, are one function called
twice. Architecture: 5 x 5 convolutions with PReLU, each followed by 2 x 2 max-pooling, then fully
connected layers down to the map.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

KERNEL = 5
SLOPE = 0.25  # where PReLU starts


@dataclass(frozen=True)
class Architecture:
    """- `size`: of the image, [pixel]. - `channels`: of the convolutions. - `hidden`: widths of the
    fully connected layers. - `dim`: of the map.

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
    """The embedding of one image; `jax.vmap` for many. `slopes` are those of every PReLU."""

    convolutions: list[eqx.nn.Conv2d]
    layers: list[eqx.nn.Linear]
    slopes: Float[Array, " activation"]
    architecture: Architecture = eqx.field(static=True)

    @classmethod
    def make(cls, architecture: Architecture, *, key: PRNGKeyArray) -> "PhysNet":
        """An untrained network; the same key gives the same."""
        channels = (1, *architecture.channels)
        side = architecture.size // 2 ** len(architecture.channels)
        widths = (channels[-1] * side**2, *architecture.hidden, architecture.dim)
        keys = iter(jax.random.split(key, len(channels) + len(widths)))
        pairs = lambda numbers: zip(numbers[:-1], numbers[1:], strict=True)
        convolve = lambda a, b, key: eqx.nn.Conv2d(a, b, KERNEL, padding=KERNEL // 2, key=key)
        return cls(
            [_scaled(convolve, a, b, next(keys)) for a, b in pairs(channels)],
            [
                _scaled(lambda a, b, key: eqx.nn.Linear(a, b, key=key), a, b, next(keys))
                for a, b in pairs(widths)
            ],
            jnp.full(len(architecture.channels) + len(architecture.hidden), SLOPE, float),
            architecture,
        )

    def __call__(self, image: Float[Array, "down across"]) -> Float[Array, " dim"]:
        """Where an image lies on the map. Raises `ValueError` when it is of another size."""
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


def _scaled(make, inputs: int, outputs: int, key: PRNGKeyArray):
    """A layer whose outputs vary as much as its inputs (He et al. 2015), with biases of zero."""
    layer = make(inputs, outputs, key)
    weight = layer.weight
    scale = jnp.sqrt(2 / (weight.size // outputs)).astype(weight.dtype)
    weight = scale * jax.random.normal(key, weight.shape, weight.dtype)
    return eqx.tree_at(lambda at: (at.weight, at.bias), layer, (weight, 0 * layer.bias))


def _prelu(values: Array, slope: Float[Array, ""]) -> Array:
    return jnp.where(values > 0, values, slope * values)


def _halved(values: Float[Array, "channel down across"]) -> Array:
    """The greatest of each 2 x 2 pixels."""
    channel, down, across = values.shape
    return jnp.max(values.reshape(channel, down // 2, 2, across // 2, 2), axis=(2, 4))
