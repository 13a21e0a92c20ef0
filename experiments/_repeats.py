"""How often the intervals of many estimates hold the truth, by parameter."""

import numpy as np
from _tables import Line
from scipy.stats import norm

BEFORE, BEHIND = "repeat", "identifiable off at most"  # the columns around those of parameters
BEYOND = (BEHIND, "converged", "recordings agree")
DIVERGED = "(inf)"  # what is no estimate holds no truth


def by_parameter(lines: list[Line]) -> list[Line]:
    """One line for each parameter, and one for all; none where all estimates diverged."""
    columns = next((list(line) for line in lines if line.get(BEHIND)), [BEFORE, BEHIND])
    names = [name for name in columns[columns.index(BEFORE) + 1 :] if name not in BEYOND]
    if not names:
        return []
    told = np.array([[line.get(name) or DIVERGED for name in names] for line in lines])
    known = ~np.char.startswith(told, "(")
    away = np.abs(np.char.strip(told, "()").astype(float))
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
