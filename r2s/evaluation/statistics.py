"""Levels of all statistics; corrections of many tests; tests of ranks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

LEVEL = 0.9  # of every interval
SIGNIFICANCE = 0.05  # of every test


def holm(p: Sequence[float]) -> np.ndarray:
    """Holm's correction of p for as many tests as there are finite numbers; NaN stays NaN."""
    values = np.asarray(p, float)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(values[known], kind="stable")]
    corrected = np.full(len(values), np.nan)
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(values[order] * factors))
    return corrected


class Friedman(NamedTuple):
    """Friedman's test that treatments are alike: its statistic, p, and the number of blocks."""

    statistic: float
    p: float
    blocks: int


def friedman(values: Float[np.ndarray, "treatment block"]) -> Friedman:
    """Friedman's test; NaN where SciPy has none: fewer than three treatments, or two blocks."""
    treatments, blocks = values.shape
    if treatments < 3 or blocks < 2 or np.all(values == values[:1]):
        return Friedman(np.nan, np.nan, blocks)
    found = stats.friedmanchisquare(*values)
    return Friedman(float(found.statistic), float(found.pvalue), blocks)


def critical_difference(treatments: int, blocks: int) -> float:
    """The difference from which on two mean ranks are told apart (Nemenyi's test).

    Demsar 2006, Statistical comparisons of classifiers over multiple data sets, section 3.2.2.
    """
    studentized = stats.studentized_range.ppf(1 - SIGNIFICANCE, treatments, np.inf) / np.sqrt(2)
    return float(studentized * np.sqrt(treatments * (treatments + 1) / (6 * blocks)))
