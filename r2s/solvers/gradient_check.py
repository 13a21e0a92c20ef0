"""Derivatives of one's own function of a fabric, beside central differences."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.flatten_util
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric

WIDTHS = (1e-3, 2.5e-4)  # relative, to either side
TOLERANCE = 1e-3
ROUNDING = 1e-9  # of the function's value: a derivative that changes it by less is none


class Row(NamedTuple):
    """One number of a fabric.

    - `parameter`, `value`: which, in its unit.
    - `derivative`: of the function in it, by JAX.
    - `differences`: central, from two widths, of which `wide` and `narrow` are those of each.
    - `verdict`: "agrees"; "differs"; "rough", when the differences do not settle, so that nothing
      is said; "not finite".
    """

    parameter: str
    value: float
    derivative: float
    differences: float
    wide: float
    narrow: float
    verdict: str


def compare(
    function: Callable[[Fabric], Float[Array, ""]],
    fabric: Fabric,
    *,
    forward: bool = False,
    tolerance: float = TOLERANCE,
) -> list[Row]:
    """The derivatives of a function in every number of a fabric, in the order of its leaves.

    By reverse mode, or by `forward` mode. Call it in double precision (`jax.enable_x64`): single
    precision says "rough" of most. It runs the function four times a number.

    >>> from r2s.materials.presets import black_denim
    >>> with jax.enable_x64(True):
    ...     rows = compare(lambda fabric: fabric.friction**2, black_denim())
    >>> {row.verdict for row in rows}
    {'agrees'}
    """
    start, unravel = jax.flatten_util.ravel_pytree(fabric)

    def of_vector(vector: Float[Array, " number"]) -> Float[Array, ""]:
        return function(unravel(vector))

    slope = jax.jit((jax.jacfwd if forward else jax.grad)(of_vector))(start)
    value = jax.jit(of_vector)
    return [
        judge(name, value, start, i, float(slope[i]), tolerance)
        for i, name in enumerate(_names(fabric))
    ]


def judge(
    name: str,
    function: Callable[[Float[Array, " number"]], Float[Array, ""]],
    start: Float[Array, " number"],
    i: int,
    slope: float,
    tolerance: float = TOLERANCE,
) -> Row:
    """The derivative `slope` in number `i` of a vector beside differences, and a verdict."""
    value = float(start[i])
    scale = abs(value) or 1.0

    def difference(width: float) -> float:
        above, below = (function(start.at[i].add(sign * width * scale)) for sign in (1, -1))
        return float(above - below) / (2 * width * scale)

    wide, narrow = (difference(width) for width in WIDTHS)
    # central differences err with the square of their width
    best = narrow + (narrow - wide) / ((WIDTHS[0] / WIDTHS[1]) ** 2 - 1)
    least = ROUNDING * abs(float(function(start))) / scale
    size = max(abs(best), abs(slope), least)
    if not all(map(math.isfinite, (wide, narrow, slope))):
        verdict = "not finite"
    elif abs(slope - best) <= tolerance * size or size == least:
        verdict = "agrees"
    elif abs(narrow - wide) > tolerance * size:
        verdict = "rough"
    else:
        verdict = "differs"
    return Row(name, value, slope, best, wide, narrow, verdict)


def _names(fabric: Fabric) -> list[str]:
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(fabric)[0]:
        name = jax.tree_util.keystr(path).lstrip(".")
        names += [name] if leaf.ndim == 0 else [f"{name}[{i}]" for i in range(leaf.size)]
    return names
