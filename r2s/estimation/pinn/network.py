"""The network: a multilayer perceptron from (X, Y, t) to a displacement, with its derivatives.

The derivatives are carried forward through the layers beside the value, all in one matrix product
a layer: no backward pass is nested in another.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

WIDTH, LAYERS = 50, 7  # the paper's seven layers: six hidden ones and the last
X, Y, T = range(3)  # the inputs
STRONG = ((X, X), (X, Y), (Y, Y), (T, T))  # second derivatives of the equation of motion
WEAK = ((X, T), (Y, T), (T, T))  # of the virtual work: none of second order in space


class Jet(eqx.Module):
    """Displacements at points, with derivatives.

    - `value`: [m].
    - `first`: in X [-], Y [-] and t [m/s].
    - `second`: of the pairs that were asked for, in their units.
    """

    value: Float[Array, "*point axis"]
    first: Float[Array, "3 *point axis"]
    second: Float[Array, "pair *point axis"]


@runtime_checkable
class DisplacementField(Protocol):
    """What the losses ask of a network; an exact solution will do."""

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Displacements [m] at points (X [m], Y [m], t [s])."""
        ...

    def jet(self, points: Float[Array, "point 3"], pairs: tuple[tuple[int, int], ...]) -> Jet:
        """Displacements with first derivatives, and second ones in pairs of inputs."""
        ...


class Network(eqx.Module):
    """Displacement [m] at material points and times, by layers of tanh.

    - `weights`, `biases`: of the layers.
    - `centre`, `radius`: of the inputs X [m], Y [m], t [s], which become -1..1.
    - `scale`: displacement [m] that an output of 1 stands for.
    """

    weights: tuple[Float[Array, "*batch _ _"], ...]
    biases: tuple[Float[Array, "*batch _"], ...]
    centre: Float[Array, "*batch 3"]
    radius: Float[Array, "*batch 3"]
    scale: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        low: Float[Array, " 3"],
        high: Float[Array, " 3"],
        scale: Float[Array, ""],
        *,
        axes: int = 2,
        width: int = WIDTH,
        layers: int = LAYERS,
        key: PRNGKeyArray,
    ) -> "Network":
        """A network with random weights (Glorot) for inputs between `low` and `high` [m, m, s]."""
        sizes = (3, *(layers - 1) * (width,), axes)
        draw = jax.nn.initializers.glorot_normal()
        keys, dtype = jr.split(key, layers), jnp.zeros((), float).dtype
        weights = [draw(k, (sizes[i], sizes[i + 1]), dtype) for i, k in enumerate(keys)]
        biases = [jnp.zeros(size, float) for size in sizes[1:]]
        centre, radius = (low + high) / 2, (high - low) / 2
        return cls(tuple(weights), tuple(biases), centre, radius, scale)

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Displacements [m] at points (X [m], Y [m], t [s])."""
        z = (points - self.centre[None]) / self.radius[None]
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for inner, offset in hidden:
            z = jnp.tanh(z @ inner + offset[None])
        return self.scale * (z @ weight + bias[None])

    def jet(self, points: Float[Array, "point 3"], pairs: tuple[tuple[int, int], ...]) -> Jet:
        """Displacements [m] with their first derivatives and second ones in `pairs` of inputs.

        Through z = tanh(a): z_i = z' a_i, z_ij = z' a_ij + z'' a_i a_j, where z' = 1 - z^2 and
        z'' = -2 z z'.
        """
        (weight, bias), *layers = zip(self.weights, self.biases, strict=True)
        value = (points - self.centre[None]) / self.radius[None] @ weight + bias[None]
        slopes = [jnp.broadcast_to(row, value.shape) for row in weight / self.radius[:, None]]
        curves = [jnp.zeros_like(value) for _ in pairs]
        for weight, bias in layers:
            z = jnp.tanh(value)
            slope = 1 - z**2
            curve = -2 * z * slope
            # lists, because gradients of indexed arrays are slow scatters
            curves = [
                slope * own + curve * slopes[i] * slopes[j]
                for own, (i, j) in zip(curves, pairs, strict=True)
            ]
            slopes = [slope * own for own in slopes]
            product = jnp.concatenate([z, *slopes, *curves]) @ weight
            value, *parts = jnp.split(product, 4 + len(pairs))
            value, slopes, curves = value + bias[None], parts[:3], parts[3:]
        none = jnp.zeros((0, *value.shape), value.dtype)
        second = jnp.stack(curves) if pairs else none
        return Jet(self.scale * value, self.scale * jnp.stack(slopes), self.scale * second)


def at_time(places: Float[Array, "place 2"], time: Float[Array, ""]) -> Float[Array, "place 3"]:
    """Places (X, Y) [m] at one time [s]: what a network of three axes takes."""
    return jnp.concatenate([places, jnp.broadcast_to(time, (len(places), 1))], axis=1)
