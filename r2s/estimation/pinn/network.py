"""A multilayer perceptron from (X, Y, t) to a displacement, with its derivatives.

The network is a module of flax. Its derivatives are carried forward through the layers beside the
value, all in one matrix product for each layer: no backward pass is nested in another.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

try:
    import flax.linen as nn
except ImportError as error:
    raise ImportError("the physics-informed network needs flax: pip install 'r2s[pinn]'") from error

WIDTH, LAYERS = 50, 7  # of the published network: six hidden layers and the last one
AXES = 2  # outputs: displacements along X and Y
X, Y, T = range(3)  # the inputs
STRONG = ((X, X), (X, Y), (Y, Y), (T, T))  # second derivatives in the equation of motion
WEAK = ((X, T), (Y, T), (T, T))  # second derivatives in the virtual work: none in space alone

Pairs = tuple[tuple[int, int], ...]  # inputs in which a second derivative is taken


class Jet(eqx.Module):
    """Displacements at points, with derivatives.

    - `value`: displacements [m].
    - `first`: derivatives in X [-], Y [-] and t [m/s].
    - `second`: derivatives in the pairs of inputs that were asked for, in their units.
    """

    value: Float[Array, "*point axis"]
    first: Float[Array, "3 *point axis"]
    second: Float[Array, "pair *point axis"]


@runtime_checkable
class DisplacementField(Protocol):
    """What the losses ask of a network. An exact solution in closed form has it too."""

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Displacements [m] at points (X [m], Y [m], t [s])."""
        ...

    def jet(self, points: Float[Array, "point 3"], pairs: Pairs) -> Jet:
        """Displacements with first derivatives, and second ones in `pairs` of inputs."""
        ...


class Perceptron(nn.Module):
    """Layers of tanh, the last one linear, from three inputs in -1..1 to two outputs.

    - `width`: of the hidden layers.
    - `layers`: how many there are, with the last one.
    """

    width: int
    layers: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Widths from the inputs to the outputs."""
        return (3, *(self.layers - 1) * (self.width,), AXES)

    def setup(self) -> None:
        shapes = list(zip(self.sizes, self.sizes[1:], strict=False))
        draw, zeros = nn.initializers.glorot_normal(), nn.initializers.zeros
        self.kernels = [self.param(f"kernel_{i}", draw, shape) for i, shape in enumerate(shapes)]
        self.biases = [self.param(f"bias_{i}", zeros, shape[1:]) for i, shape in enumerate(shapes)]

    def __call__(self, inputs: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Outputs at inputs."""
        *hidden, (kernel, bias) = zip(self.kernels, self.biases, strict=True)
        for inner, offset in hidden:
            inputs = jnp.tanh(inputs @ inner + offset[None])
        return inputs @ kernel + bias[None]

    def jet(self, inputs: Float[Array, "point 3"], radius: Float[Array, " 3"], pairs: Pairs) -> Jet:
        """Outputs with their first derivatives, and second ones in `pairs`.

        Derivatives are in the inputs times their `radius`. Through z = tanh(a) they are
        z_i = z' a_i and z_ij = z' a_ij + z'' a_i a_j, where z' = 1 - z^2 and z'' = -2 z z'.
        """
        (kernel, bias), *layers = zip(self.kernels, self.biases, strict=True)
        value = inputs @ kernel + bias[None]
        slopes = [jnp.broadcast_to(row, value.shape) for row in kernel / radius[:, None]]
        curves = [jnp.zeros_like(value) for _ in pairs]
        for kernel, bias in layers:
            z = jnp.tanh(value)
            slope = 1 - z**2
            curve = -2 * z * slope
            # lists, because gradients of indexed arrays are slow scatters
            curves = [
                slope * own + curve * slopes[i] * slopes[j]
                for own, (i, j) in zip(curves, pairs, strict=True)
            ]
            slopes = [slope * own for own in slopes]
            product = jnp.concatenate([z, *slopes, *curves]) @ kernel
            value, *parts = jnp.split(product, 4 + len(pairs))
            value, slopes, curves = value + bias[None], parts[:3], parts[3:]
        none = jnp.zeros((0, *value.shape), value.dtype)
        return Jet(value, jnp.stack(slopes), jnp.stack(curves) if pairs else none)


class Network(eqx.Module):
    """Displacement [m] at material points and times: a perceptron with parameters and scales.

    - `module`: the perceptron.
    - `params`: its kernels and biases by name, as flax has them.
    - `centre`, `radius`: of the inputs X [m], Y [m], t [s], which become -1..1.
    - `scale`: displacement [m] that an output of 1 stands for.
    """

    module: Perceptron = eqx.field(static=True)
    params: dict[str, Array]
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
        width: int = WIDTH,
        layers: int = LAYERS,
        shrink: float = 1.0,
        key: PRNGKeyArray,
    ) -> "Network":
        """A network with random kernels (Glorot) and no biases.

        - `low`, `high`: ends of the inputs [m, m, s].
        - `scale`: displacement [m] that an output of 1 stands for.
        - `width`, `layers`: see `Perceptron`.
        - `shrink`: what the last kernel is divided by, for a motion that begins small.
        """
        module = Perceptron(width, layers)
        draw, dtype = jax.nn.initializers.glorot_normal(), jnp.zeros((), float).dtype
        shapes, params = zip(module.sizes, module.sizes[1:], strict=False), {}
        for i, (shape, key_layer) in enumerate(zip(shapes, jr.split(key, layers), strict=True)):
            params[f"kernel_{i}"] = draw(key_layer, shape, dtype)
            params[f"bias_{i}"] = jnp.zeros(shape[1], dtype)
        params[f"kernel_{layers - 1}"] /= shrink
        return cls(module, params, (low + high) / 2, (high - low) / 2, scale)

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Displacements [m] at points (X [m], Y [m], t [s])."""
        return self.scale * self._apply(points)

    def jet(self, points: Float[Array, "point 3"], pairs: Pairs) -> Jet:
        """Displacements [m] with first derivatives, and second ones in `pairs` of inputs."""
        found = self._apply(points, self.radius, pairs, method=Perceptron.jet)
        return jax.tree.map(lambda part: self.scale * part, found)

    def _apply(self, points: Float[Array, "point 3"], *rest, method=None) -> Any:
        inputs = (points - self.centre[None]) / self.radius[None]
        return self.module.apply({"params": self.params}, inputs, *rest, method=method)
