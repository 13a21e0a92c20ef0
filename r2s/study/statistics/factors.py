"""How much of the variance of the logarithm of a distance each factor of the study explains.

Factors are the approach, the solver and the scenario that a configuration is made of; the fabric;
the motion that is judged, and in it the trajectory. The rest is interactions and the spread of
repeats.

The design is not balanced, and partly confounded: an approach that works from one scenario only
cannot be told from that scenario. So there is no one share of a factor: what it adds to the
explained variance depends on which factors are there before it. Shares here are means over all
orders in which the factors may enter (Lindeman, Merenda and Gold 1980; Shapley's value of the
explained variance), a trajectory always after the fabric and the motion that it lies in.
Confounded factors share evenly what no data could tell apart, and the shares and the rest sum to
one. The explained variance is adjusted for degrees of freedom, so that a factor without effect has
a share of zero on average, which may come out slightly below.

Shares describe these results: a few fabrics say too little of how others would share it for an
interval that keeps what it promises.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer

from r2s.study.statistics.result_array import ResultArray
from r2s.study.tables import MISSING, Table

NESTED = {"trajectory": ("fabric", "motion")}  # what must enter before it
REST = "rest"
ROUNDING = 1e-9  # of singular values: what is dependent on other columns of the design


class Shares(NamedTuple):
    """Shares of the variance.

    - `factors`: their names, those with one level only left out; the last is the rest.
    - `deviation`: of the logarithm of the distance, [-].
    - `confounded`: pairs of factors, one of which tells the other.
    - `count`, `diverged`: values that count, and those that do not, for they diverged.
    """

    factors: tuple[str, ...]
    share: Float[np.ndarray, " factor"]
    deviation: float
    confounded: tuple[tuple[str, str], ...]
    count: int
    diverged: int


class _Data(NamedTuple):
    y: Float[np.ndarray, " value"]
    levels: dict[str, Integer[np.ndarray, " value"]]  # but for trajectories
    trajectory: Integer[np.ndarray, " value"]  # ascending


def variance_shares(results: ResultArray) -> Shares | None:
    """The shares of the variance without default fabrics; None where nothing varies."""
    data = _data(results)
    if len(data.y) < 3 or np.ptp(data.y) == 0:
        return None
    names = tuple(name for name, level in data.levels.items() if level.max() > 0)
    cells = set(zip(data.levels["fabric"].tolist(), data.levels["motion"].tolist(), strict=True))
    is_nested = len(np.unique(data.trajectory)) > len(cells)
    factors = (*names, "trajectory") if is_nested else names
    if not factors:
        return None
    return Shares(
        factors=(*factors, REST),
        share=_shares(data, factors),
        deviation=float(data.y.std()),
        confounded=_confounded(data, names),
        count=len(data.y),
        diverged=int(results.diverged.sum()),
    )


def _data(results: ResultArray) -> _Data:
    """One entry for each finite distance, those of a trajectory side by side."""
    estimates = np.array([bool(c.approach) for c in results.configurations], bool)
    known = np.isfinite(results.values) & (np.nan_to_num(results.values) > 0)
    known &= estimates[:, None, None]
    trajectory, configuration, repeat = np.nonzero(known.transpose(1, 0, 2))
    configurations = [results.configurations[i] for i in configuration]
    places = [results.trajectories[i] for i in trajectory]
    named = {
        "approach": [c.approach for c in configurations],
        "solver": [c.solver for c in configurations],
        "scenario": [c.estimated_from for c in configurations],
        "fabric": [t.fabric for t in places],
        "motion": [t.evaluated_on for t in places],
    }
    levels = {name: np.unique(texts, return_inverse=True)[1] for name, texts in named.items()}
    logs = np.log(results.values[configuration, trajectory, repeat])
    return _Data(logs, levels, trajectory)


def _shares(data: _Data, factors: tuple[str, ...]) -> np.ndarray:
    """The mean of what each factor adds, over the orders that nesting allows; then the rest."""
    explained = {frozenset(): 0.0}
    design = _Design(data)
    added = dict.fromkeys(factors, 0.0)
    orders = _orders(factors)
    for order in orders:
        for i, name in enumerate(order):
            before, after = frozenset(order[:i]), frozenset(order[: i + 1])
            if after not in explained:
                explained[after] = design.explained(after)
            added[name] += (explained[after] - explained[before]) / len(orders)
    return np.array([*added.values(), 1 - explained[frozenset(factors)]])


def _orders(factors: tuple[str, ...]) -> list[tuple[str, ...]]:
    def is_allowed(order: tuple[str, ...]) -> bool:
        return all(
            order.index(outer) < order.index(inner)
            for inner, outers in NESTED.items()
            for outer in outers
            if inner in order and outer in order
        )

    return list(filter(is_allowed, permutations(factors)))


class _Design:
    """The sums from which the fit of any set of factors follows.

    Trajectories are many: instead of a column for each, their means are taken out of the others.
    """

    def __init__(self, data: _Data):
        blocks = {
            name: level[:, None] == np.arange(1, level.max() + 1)
            for name, level in data.levels.items()
        }
        ends = np.cumsum([block.shape[1] for block in blocks.values()])
        starts = (end - block.shape[1] for end, block in zip(ends, blocks.values(), strict=True))
        self.columns = {
            name: list(range(start, end))
            for name, start, end in zip(blocks, starts, ends, strict=True)
        }
        table = np.concatenate([*blocks.values(), data.y[:, None]], axis=1).astype(float)
        self.count = len(table)
        first = np.flatnonzero(np.diff(data.trajectory, prepend=-1))
        sums, totals = np.add.reduceat(table, first), np.diff(first, append=self.count)
        square, total = table.T @ table, table.sum(axis=0)
        self.trajectories = len(first)
        self.around_mean = (square - np.outer(total, total) / self.count) / self.count
        self.within = (square - (sums / totals[:, None]).T @ sums) / self.count

    def explained(self, factors: frozenset[str]) -> float:
        """The share of the variance that factors explain, adjusted for degrees of freedom."""
        is_nested = "trajectory" in factors
        products = self.within if is_nested else self.around_mean
        inside = NESTED["trajectory"] if is_nested else ()
        index = [
            i for name in sorted(factors - {"trajectory", *inside}) for i in self.columns[name]
        ]
        left, parameters = products[-1, -1], self.trajectories if is_nested else 1
        if index:
            values, vectors = np.linalg.eigh(products[np.ix_(index, index)])
            kept = values > ROUNDING * max(1.0, values[-1])
            along = vectors[:, kept].T @ products[index, -1]
            left -= float(np.sum(along**2 / values[kept]))
            parameters += int(kept.sum())
        free = self.count - parameters
        if free <= 0:
            return 1.0
        total = self.around_mean[-1, -1] * self.count / (self.count - 1)
        return 1 - left * self.count / free / total if total > 0 else 0.0


def _confounded(data: _Data, names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Pairs of factors of which a level of one comes with just one level of the other."""
    found = []
    for one, other in combinations(names, 2):
        shape = data.levels[one].max() + 1, data.levels[other].max() + 1
        pairs: Bool[np.ndarray, "a b"] = np.zeros(shape, bool)
        pairs[data.levels[one], data.levels[other]] = True
        if (pairs.sum(axis=0) == 1).any() or (pairs.sum(axis=1) == 1).any():
            found.append((one, other))
    return tuple(found)


def share_table(found: Mapping[str, Shares], caption: str) -> Table:
    """Shares by motion, [%]: a line a factor."""
    shown = [_cells(each) for each in found.values()]
    factors = dict.fromkeys(name for cells in shown for name in cells if name != REST)
    return Table(
        ("factor", *(f"{motion} [%]" for motion in found)),
        tuple((name, *(c.get(name, MISSING) for c in shown)) for name in (*factors, REST)),
        f"{caption}: shares of the variance of the log distance in these results. "
        f"{_in_words(found)}",
        foot=1,
    )


def _cells(shares: Shares) -> dict[str, str]:
    return {name: _percent(share) for name, share in zip(shares.factors, shares.share, strict=True)}


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".replace("-0.0", "0.0")


def _in_words(found: Mapping[str, Shares]) -> str:
    """What the shares are of."""
    counts = ", ".join(
        f"{each.count} on {motion} (deviation of the logarithm {100 * each.deviation:.0f} %"
        + (f"; {each.diverged} more diverged, and have none)" if each.diverged else ")")
        for motion, each in found.items()
    )
    pairs = dict.fromkeys(" and ".join(pair) for each in found.values() for pair in each.confounded)
    if not pairs:
        return f"Distances: {counts}."
    return (
        f"Distances: {counts}. Not crossed in full, so that they share what cannot be told apart: "
        f"{', '.join(pairs)}."
    )
