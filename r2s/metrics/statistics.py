"""Means over a sample of units measured under the same levels of other factors.

Fabrics are the units, motions such a factor: all fabrics make the same motions, whose share of the
variance is not in the spread between fabrics. Components of the variance:
Cornfield and Tukey 1956, Average values of mean squares in factorials; degrees of freedom:
Satterthwaite 1946, An approximate distribution of estimates of variance components.
"""

from bisect import bisect_left
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special, stats

LEVEL = 0.9  # of every interval
SIGNIFICANCE = 0.05  # of every test
POWER = 0.8  # of a study that is large enough
MOST_UNITS = 1000  # that are worth a number


class CrossedMean(NamedTuple):
    """The mean of a sample of units and its uncertainty, in the units of the numbers.

    - `mean`: over `units` units. `spread`: deviation between them; NaN for one unit.
    - `shared`: variance of the mean by the levels of the other factors.
    - `freedom`: degrees of freedom of the variance of the mean.
    """

    mean: float
    units: int
    spread: float
    shared: float
    freedom: float

    @property
    def error(self) -> float:
        """The standard error of the mean; NaN for fewer than two units."""
        if self.units < 2:
            return np.nan
        return float(np.sqrt(self.spread**2 / self.units + self.shared))


def crossed_mean(
    numbers: Float[np.ndarray, " unit"], tables: Iterable[Float[np.ndarray, "unit _"]] = ()
) -> CrossedMean:
    """The mean of one number a unit.

    `tables`: the same numbers by the levels of another factor that all units share, one table a
    factor; levels that a unit lacks (NaN) do not count. A factor's share of the variance is that
    of the means of its levels, less the part due to interaction with units.
    """
    count = len(numbers)
    if count < 2:
        return CrossedMean(float(numbers.mean()) if count else np.nan, count, np.nan, 0.0, np.nan)
    parts = [(float(numbers.var(ddof=1)) / count, count - 1)]
    parts += [_shared(table[:, np.isfinite(table).all(axis=0)]) for table in tables]
    total = sum(part for part, _ in parts)
    weight = sum(part**2 / free for part, free in parts)
    return CrossedMean(
        mean=float(numbers.mean()),
        units=count,
        spread=float(numbers.std(ddof=1)),
        shared=float(sum(part for part, _ in parts[1:])),
        freedom=float(total**2 / weight) if weight > 0 else float(count - 1),
    )


def _shared(table: Float[np.ndarray, "unit level"]) -> tuple[float, int]:
    """The variance of the mean by levels, and its degrees of freedom."""
    units, levels = table.shape
    if levels < 2:
        return 0.0, 1
    of_level = table.mean(axis=0)
    rest = table - table.mean(axis=1, keepdims=True) - of_level + table.mean()
    interaction = float((rest**2).sum()) / ((units - 1) * (levels - 1))
    between = float(of_level.var(ddof=1)) / levels
    return max(0.0, between - interaction / (units * levels)), levels - 1


def interval(sample: CrossedMean) -> tuple[float, float]:
    """The interval of `LEVEL` for the mean of all units (Student's t); NaN for one unit."""
    reach = float(special.stdtrit(sample.freedom, (1 + LEVEL) / 2)) * sample.error
    return sample.mean - reach, sample.mean + reach


def p_value(sample: CrossedMean) -> float:
    """The two-sided p that the mean of all units is zero (Student's t); NaN for one unit.

    With at most the degrees of freedom of the units alone: Satterthwaite's are many where the
    spread happens to be small, too many for the tails that a correction for many tests needs.
    """
    if sample.units < 2:
        return np.nan
    if sample.error == 0:
        return 0.0 if sample.mean else 1.0
    freedom = min(sample.freedom, sample.units - 1)
    return float(2 * special.stdtr(freedom, -abs(sample.mean) / sample.error))


def units_needed(
    sample: CrossedMean, effect: float, significance: float
) -> tuple[float, float, float]:
    """How many units distinguish a mean of `effect` from zero with a power of `POWER`.

    First with the spread found, then with the ends of its interval of `LEVEL`; infinite above
    `MOST_UNITS`, NaN for one unit. By the noncentral t distribution (Cohen 1988, Statistical power
    analysis for the behavioral sciences, chapter 2).
    """
    if sample.units < 2:
        return np.nan, np.nan, np.nan
    free = sample.units - 1
    ends = free / stats.chi2.ppf([(1 + LEVEL) / 2, (1 - LEVEL) / 2], free)
    counts = range(2, MOST_UNITS + 1)

    def needed(scale: float) -> float:
        variance = sample.spread**2 * scale
        place = bisect_left(
            counts, POWER, key=lambda n: _power(n, variance, sample.shared, effect, significance)
        )
        return float(counts[place]) if place < len(counts) else np.inf

    return needed(1.0), needed(ends[0]), needed(ends[1])


def _power(units: int, variance: float, shared: float, effect: float, significance: float) -> float:
    error = np.sqrt(variance / units + shared)
    if error == 0:
        return 1.0
    beyond = special.stdtrit(units - 1, 1 - significance / 2)
    power = 1 - float(special.nctdtr(units - 1, abs(effect) / error, beyond))
    # SciPy has no number for what is far out in a tail.
    return power if np.isfinite(power) else float(abs(effect) / error > beyond)
