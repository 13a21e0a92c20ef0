"""Sums over batches of points whose gradient is made along with them, batch by batch.

What a batch needs then stays in the processor's cache: the gradient of the paper's equation of
motion takes 21 ms instead of 62 for all points at once.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, Shaped


@eqx.filter_custom_vjp
def summed(
    weights: PyTree,
    term: Callable[..., Float[Array, ""]],
    batches: PyTree[Shaped[Array, "batch ..."]],
    *about: Any,
) -> Float[Array, ""]:
    """The sum of `term(weights, batch, *about)` over the first axis of `batches`.

    Gradients are of `weights` alone, which are floating point arrays: `batches` and `about` count
    as constants.
    """
    zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(weights)))
    add = lambda total, batch: (total + term(weights, batch, *about), None)
    return jax.lax.scan(add, zero, batches)[0]


@summed.def_fwd
def _forward(perturbed, weights, term, batches, *about):
    del perturbed

    def add(total, batch):
        found = jax.value_and_grad(term)(weights, batch, *about)
        return jax.tree.map(jnp.add, total, found), None

    slope = jax.tree.map(jnp.zeros_like, weights)
    zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(weights)))
    return jax.lax.scan(add, (zero, slope), batches)[0]


@summed.def_bwd
def _backward(slope, cotangent, perturbed, weights, term, batches, *about):
    del perturbed, weights, term, batches, about
    return jax.tree.map(lambda leaf: cotangent * leaf, slope)
