"""The table of what was estimated: a line an estimate, a column a parameter."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from r2s.fabrics.parameters import Range
from r2s.study.tables import MISSING, Table, significant


class Estimated(NamedTuple):
    """The parameters of one estimate, in the order of their ranges.

    - `values` [unit of the range].
    - `standard_errors`: relative for a logarithmic range, else [unit].
    - `identifiable`: whether the recording determined the parameter.
    - `truth` [unit]: NaN where unknown.
    """

    name: str
    ranges: tuple[Range, ...]
    values: Float[np.ndarray, " dim"]
    standard_errors: Float[np.ndarray, " dim"]
    identifiable: Bool[np.ndarray, " dim"]
    truth: Float[np.ndarray, " dim"]


def parameter_table(estimates: Sequence[Estimated], caption: str) -> Table:
    """The table of estimates, whose ranges may differ: a parameter that one lacks is "-"."""
    names = list(dict.fromkeys(bound.name for each in estimates for bound in each.ranges))
    lines = []
    for name, ranges, *arrays in estimates:
        numbers = zip(ranges, *(np.asarray(array).tolist() for array in arrays), strict=True)
        shown = {bound.name: _cell(bound, *rest) for bound, *rest in numbers}
        lines.append((name, *(shown.get(parameter, MISSING) for parameter in names)))
    return Table(("recording", *names), tuple(lines), caption)


def _cell(
    bound: Range, value: float, standard_error: float, is_identifiable: bool, truth: float
) -> str:
    unit = "" if bound.unit in ("", "-") else f" {bound.unit}"
    if is_identifiable:
        text = _plus_minus(value, standard_error * (abs(value) if bound.log else 1)) + unit
    else:
        text = f"not determined (best fit {significant(value)}{unit})"
    return text if math.isnan(truth) else f"{text}; truth {significant(truth)}{unit}"


def _plus_minus(value: float, deviation: float) -> str:
    """Both to the second digit of the deviation."""
    if not (np.isfinite([value, deviation]).all() and deviation > 0):
        return f"{significant(value)} ± {significant(deviation)}"
    top, last = (math.floor(math.log10(size)) for size in (max(abs(value), deviation), deviation))
    if -3 <= top < 5:
        decimals = max(0, 1 - last)
        return f"{value:.{decimals}f} ± {deviation:.{decimals}f}"
    return f"{value:.{top - last + 1}e} ± {deviation:.1e}"
