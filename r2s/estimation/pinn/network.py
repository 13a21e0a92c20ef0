"""A multilayer perceptron from (X, Y, t) to a displacement, with its derivatives.

The network is a module of flax. Derivatives are carried forward through the layers with the value,
in one matrix product per layer, so that no reverse pass is nested in another.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from r2s._util.extras import require

require("flax", "pinn", "the physics-informed network")
import flax.linen as nn  # noqa: E402

AXES = 2  # outputs: displacements along X and Y
X, Y, T = range(3)  # the inputs

Pairs = tuple[tuple[int, int], ...]  # inputs in which a second derivative is taken


class Jet(eqx.Module):
    """Displacements at points, with derivatives.

    - `value`: displacements [m].
    - `first`: derivatives in X [-], Y [-] and t [m/s].
    - `second`: derivatives in some pairs of inputs, in their units.
    """

    value: Float[Array, "*point axis"]
    first: Float[Array, "3 *point axis"]
    second: Float[Array, "pair *point axis"]

    @property
    def gradient(self) -> Float[Array, "*point axis 2"]:
        """Derivatives in X and Y [-]."""
        return jnp.moveaxis(self.first[:2], 0, -1)


class Perceptron(nn.Module):
    """Layers of tanh, the last one linear, from three inputs in -1..1 to two outputs.

    - `width`: of the hidden layers. - `layers`: their number, the last one included.
    """

    width: int
    layers: int

    def setup(self) -> None:
        sizes = (3, *(self.layers - 1) * (self.width,), AXES)
        shapes = list(enumerate(zip(sizes, sizes[1:], strict=False)))
        glorot, zeros = nn.initializers.glorot_normal(), nn.initializers.zeros
        dtype = jnp.zeros((), float).dtype
        self.kernels = [self.param(f"kernel_{i}", glorot, shape, dtype) for i, shape in shapes]
        self.biases = [self.param(f"bias_{i}", zeros, shape[1:], dtype) for i, shape in shapes]

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
                slope * second + curve * slopes[i] * slopes[j]
                for second, (i, j) in zip(curves, pairs, strict=True)
            ]
            slopes = [slope * first for first in slopes]
            product = jnp.concatenate([z, *slopes, *curves]) @ kernel
            value, *parts = jnp.split(product, 4 + len(pairs))
            value, slopes, curves = value + bias[None], parts[:3], parts[3:]
        return Jet(value, jnp.stack(slopes), jnp.stack(curves))


class Network(eqx.Module):
    """Displacement [m] at material points and times: a perceptron with parameters and scales.

    - `params`: kernels and biases of the `module` by name, as flax has them.
    - `centre`, `radius`: of the inputs X [m], Y [m], t [s], which become -1..1; not trained.
    - `scale`: displacement [m] for an output of 1; not trained.
    """

    module: Perceptron = eqx.field(static=True)
    params: dict[str, Array]
    centre: Float[Array, "*batch 3"]
    radius: Float[Array, "*batch 3"]
    scale: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        high: Float[Array, " 3"],
        scale: Float[Array, ""],
        *,
        width: int,
        layers: int,
        shrink: float = 1.0,
        key: PRNGKeyArray,
    ) -> "Network":
        """A network with random kernels (Glorot) and no biases, for inputs from zero to `high`.

        - `scale`: displacement [m] for an output of 1.
        - `width`, `layers`: see `Perceptron`.
        - `shrink`: divisor of the last kernel, for a motion that is small at first.
        """
        module = Perceptron(width, layers)
        params: Any = module.init(key, jnp.zeros((1, 3), float))["params"]
        params[f"kernel_{layers - 1}"] /= shrink
        return cls(module, params, high / 2, high / 2, scale)

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, "point axis"]:
        """Displacements [m] at points (X [m], Y [m], t [s])."""
        return jax.lax.stop_gradient(self.scale) * self._apply(points)

    def jet(self, points: Float[Array, "point 3"], pairs: Pairs) -> Jet:
        """Displacements [m] with first derivatives, and second ones in `pairs` of inputs."""
        radius, scale = jax.lax.stop_gradient((self.radius, self.scale))
        jet = self._apply(points, radius, pairs, method=Perceptron.jet)
        return jax.tree.map(lambda part: scale * part, jet)

    def _apply(self, points: Float[Array, "point 3"], *rest, method=None) -> Any:
        centre, radius = jax.lax.stop_gradient((self.centre, self.radius))
        inputs = (points - centre[None]) / radius[None]
        return self.module.apply({"params": self.params}, inputs, *rest, method=method)
