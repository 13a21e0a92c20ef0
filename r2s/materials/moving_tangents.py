"""Derivatives of one's own in those arguments alone that move: others have symbolic zeros."""

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero


def moves(tangent: Any) -> bool:
    """Whether any array of a tangent (a pytree) is not a symbolic zero."""
    return not all(isinstance(each, SymbolicZero) for each in _leaves(tangent))


def jvp_of_moving(function: Callable, primal: Any, tangent: Any) -> tuple[Any, Any]:
    """`jax.jvp` of a function of a pytree, in those arrays that move: the others cost nothing."""
    leaves, structure = jax.tree.flatten(primal)
    tangents = _leaves(tangent)
    moving = [i for i, each in enumerate(tangents) if not _is_zero(each)]

    def of_moving(*given):
        every = dict(enumerate(leaves)) | dict(zip(moving, given, strict=True))
        return function(structure.unflatten(every.values()))

    return jax.jvp(of_moving, [leaves[i] for i in moving], [tangents[i] for i in moving])


def _leaves(tangent: Any) -> list:
    return jax.tree.leaves(tangent, is_leaf=_is_zero)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)
