"""A function whose batch, under `jax.vmap`, is the last axis of all its arrays, and so vectorises.

`jax.vmap` of a loop puts the batch first, where it is strided over.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def batch_last(function: Callable[[bool, Any], Any], inputs: Any) -> Any:
    """`function(False, inputs)`, which under `jax.vmap` is `function(True, inputs)`.

    The latter has a batch as last axis of every array, and of every result. `jax.vmap` of
    `jax.vmap` makes one batch of both. Derivatives are those of `function(False, inputs)`, and
    with them a batch is JAX's own.
    """
    arrays, static = eqx.partition(inputs, eqx.is_array)

    def of_arrays(batched, arrays):
        return function(batched, eqx.combine(arrays, static))

    @jax.custom_batching.custom_vmap
    def of_members(arrays):
        return of_arrays(True, arrays)

    @of_members.def_vmap
    def _(size, in_batched, arrays):
        count = jax.tree.leaves(arrays)[0].shape[-1]

        def merged(leaf, is_batched):
            leaf = (
                jnp.moveaxis(leaf, 0, -1) if is_batched else jnp.repeat(leaf[..., None], size, -1)
            )
            return leaf.reshape(*leaf.shape[:-2], count * size)

        merged = of_members(jax.tree.map(merged, arrays, in_batched[0]))
        found = jax.tree.map(
            lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], count, size), -1, 0), merged
        )
        return found, jax.tree.map(lambda _: True, found)

    @jax.custom_batching.custom_vmap
    def of_one(arrays):
        return of_arrays(False, arrays)

    @of_one.def_vmap
    def _(size, in_batched, arrays):
        def last(leaf, is_batched):
            if is_batched:
                return jnp.moveaxis(leaf, 0, -1)
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, size))

        found = of_members(jax.tree.map(last, arrays, in_batched[0]))
        found = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), found)
        return found, jax.tree.map(lambda _: True, found)

    @jax.custom_jvp
    def called(arrays):
        return of_one(arrays)

    @called.defjvp
    def _(primals, tangents):
        return jax.jvp(partial(of_arrays, False), primals, tangents)

    return called(arrays)
