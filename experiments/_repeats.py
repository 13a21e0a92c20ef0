"""How often the intervals of many estimates hold the truth, by parameter."""

import numpy as np
from _tables import Line
from scipy.stats import norm

OTHERS = ("fabric", "repeat", "identifiable off at most", "converged", "recordings agree")
DIVERGED = "(inf)"  # what is no estimate holds no truth


def by_parameter(lines: list[Line]) -> list[Line]:
    """One line for each parameter, and one for all; none where all estimates diverged."""
    names = list(dict.fromkeys(name for line in lines for name in line if name not in OTHERS))
    if not any(line.get(name) for line in lines for name in names):
        return []
    cells = np.array([[line.get(name) or DIVERGED for name in names] for line in lines])
    known = ~np.char.startswith(cells, "(")
    away = np.abs(np.char.strip(cells, "()").astype(float))
    every = zip([*names, "all"], [*away.T, away.ravel()], [*known.T, known.ravel()], strict=True)
    return [{"parameter": name} | _held(errors, which) for name, errors, which in every]


def _held(errors: np.ndarray, known: np.ndarray) -> Line:
    inside = errors < norm.ppf(0.95)
    return {
        "held": f"{inside.sum()} of {len(inside)}",
        "identifiable": f"{known.sum()}",
        "held of these": f"{inside[known].sum()}" if known.any() else "-",
        "errors off at most": f"{errors[known].max():.1f}" if known.any() else "-",
    }
