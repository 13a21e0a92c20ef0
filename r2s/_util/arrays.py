"""Arrays: of numbers, traced or not, and those that XLA works out once."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike


def once(function: Callable, *arguments: Any) -> Any:
    """`function` of arrays, whose results are kept in memory.

    On a CPU XLA fuses what is worked out into the loops of all who use it, and there works it out
    again for each of their numbers (`jax.lax.optimization_barrier` is gone before that). Only a
    branch that may be taken or not holds it back: it is always taken. Where there is no number
    there is nothing to hold.
    """
    function = jax.jit(function)  # traced once for its shapes and for its branch
    shapes = jax.eval_shape(function, *arguments)
    numbers = jax.tree.leaves(arguments)[0]
    if not numbers.size:
        return function(*arguments)
    first = jnp.ravel(numbers)[0]
    always = (first <= 0) | ~(first <= 0)
    return jax.lax.cond(
        jax.lax.optimization_barrier(always),
        lambda: function(*arguments),
        lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
    )


def as_floats(numbers: ArrayLike | Sequence[float]) -> Array:
    """Numbers as an array, in JAX's default precision."""
    return jnp.asarray(numbers, float)


def is_traced(*trees: Any) -> bool:
    """Whether some array of some pytrees is traced, so that its numbers are not known."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))
