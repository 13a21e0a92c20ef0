"""The rows of one metric as an array: configuration by trajectory by repeat.

A trajectory is one judged recording. A repeat is one of several estimates of a configuration, which
is judged on all trajectories of its fabric. A bootstrap therefore draws repeats within a
configuration and a fabric, and trajectories within a fabric and a motion. The fabrics themselves
are given: intervals are about these fabrics, not about others.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer

from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.rows import Row

DRAWS, FEWEST_DRAWS = 1000, 200  # of a bootstrap
LARGE = 100_000  # values, beyond which fewer draws are made: they take as long together


class Trajectory(NamedTuple):
    """One judged recording."""

    fabric: str
    evaluated_on: str
    recording: str


class ResultArray(NamedTuple):
    """All values of one metric.

    - `values` [unit]: NaN where absent, and where the simulation diverged.
    - `present`: where there is a row; what is present and not finite diverged.
    """

    metric: str
    unit: str
    configurations: tuple[Configuration, ...]
    trajectories: tuple[Trajectory, ...]
    values: Float[np.ndarray, "configuration trajectory repeat"]
    present: Bool[np.ndarray, "configuration trajectory repeat"]

    @property
    def diverged(self) -> Bool[np.ndarray, "configuration trajectory repeat"]:
        return self.present & ~np.isfinite(self.values)

    @property
    def fabrics(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(trajectory.fabric for trajectory in self.trajectories))

    def of_fabric(self, fabric: str) -> Bool[np.ndarray, " trajectory"]:
        """Which trajectories are of a fabric."""
        return np.array([trajectory.fabric == fabric for trajectory in self.trajectories], bool)


class Weights(NamedTuple):
    """How often a resample has drawn each trajectory, and each repeat of its fabric."""

    trajectory: Float[np.ndarray, " trajectory"]
    repeat: Float[np.ndarray, "configuration trajectory repeat"]


def configurations_of(rows: Iterable[Row]) -> tuple[Configuration, ...]:
    """The configurations that rows have: the paper's first, the default fabric last."""
    found = {c for row in rows if (c := row.configuration) is not None}
    others = sorted(found - {*PAPER_CONFIGURATIONS}, key=lambda c: (not c.approach, c))
    return tuple(c for c in (*PAPER_CONFIGURATIONS, *others) if c in found)


def result_array(
    rows: Iterable[Row], metric: str, motions: Sequence[str] = MOTIONS, own: bool = False
) -> ResultArray:
    """The values of a metric on `motions`; with `own`, on what each was estimated from.

    No rows make an empty array. Raises ValueError for two rows of one place, and several units.
    """
    chosen = [
        (configuration, row)
        for row in rows
        if row.metric == metric
        and (row.evaluated_on == row.estimated_from if own else row.evaluated_on in motions)
        and (configuration := row.configuration) is not None
    ]
    units = sorted({row.unit for _, row in chosen}) or ["m"]
    if len(units) > 1:
        raise ValueError(f"{metric}: several units: {units}")
    configurations = configurations_of(row for _, row in chosen)
    where = {configuration: i for i, configuration in enumerate(configurations)}
    trajectories = tuple(
        dict.fromkeys(Trajectory(r.fabric, r.evaluated_on, r.recording) for _, r in chosen)
    )
    place = {trajectory: i for i, trajectory in enumerate(trajectories)}
    number = _repeat_numbers(chosen)
    size = len(configurations), len(trajectories), 1 + max(number.values(), default=-1)
    values, present = np.full(size, np.nan), np.zeros(size, bool)
    for configuration, row in chosen:
        trajectory = Trajectory(row.fabric, row.evaluated_on, row.recording)
        repeat = number[configuration, row.fabric, row.repeat]
        at = where[configuration], place[trajectory], repeat
        if present[at]:
            what = f"{metric} of {configuration.label}, repeat {row.repeat}, on {row.recording}"
            raise ValueError(f"two rows for one value: {what}")
        present[at] = True
        values[at] = row.value if np.isfinite(row.value) else np.nan
    return ResultArray(metric, units[0], configurations, trajectories, values, present)


def _repeat_numbers(
    chosen: Sequence[tuple[Configuration, Row]],
) -> dict[tuple[Configuration, str, str], int]:
    """Numbers from 0 on for the repeats of each configuration and fabric."""
    names: dict[tuple[Configuration, str], dict[str, int]] = {}
    for configuration, row in chosen:
        known = names.setdefault((configuration, row.fabric), {})
        known.setdefault(row.repeat, len(known))
    return {(*key, name): i for key, known in names.items() for name, i in known.items()}


def select(
    results: ResultArray,
    configurations: Callable[[Configuration], bool] = lambda _: True,
    trajectories: Callable[[Trajectory], bool] = lambda _: True,
) -> ResultArray:
    """The part of an array whose configurations and trajectories pass."""
    rows = [i for i, c in enumerate(results.configurations) if configurations(c)]
    places = [i for i, t in enumerate(results.trajectories) if trajectories(t)]
    return results._replace(
        configurations=tuple(results.configurations[i] for i in rows),
        trajectories=tuple(results.trajectories[i] for i in places),
        values=results.values[rows][:, places],
        present=results.present[rows][:, places],
    )


def on_motion(results: ResultArray, motion: str) -> ResultArray:
    """What was judged on a motion, and the configurations that have it."""
    part = select(results, trajectories=lambda t: t.evaluated_on == motion)
    judged = {c for c, there in zip(part.configurations, part.present, strict=True) if there.any()}
    return select(part, judged.__contains__)


def by_motion(results: ResultArray) -> dict[str, ResultArray]:
    """The part of an array for each unseen motion that it has, in the order of `MOTIONS`."""
    there = {trajectory.evaluated_on for trajectory in results.trajectories}
    return {motion: on_motion(results, motion) for motion in MOTIONS if motion in there}


def mean_over_repeats(
    results: ResultArray, weights: Weights | None = None, diverged: float = np.inf
) -> Float[np.ndarray, "configuration trajectory"]:
    """The mean over repeats, [unit]: NaN where absent.

    Where a repeat diverged the mean is `diverged`; if that is NaN, the mean is of the others. Where
    none of a trajectory's repeats was drawn all of them count, since each recording may have an
    estimate of its own.
    """
    weight = results.present * 1.0
    if weights is not None:
        drawn = weight * weights.repeat
        weight = np.where(drawn.any(axis=2, keepdims=True), drawn, weight)
    finite = weight * np.isfinite(results.values)
    count = finite.sum(axis=2)
    total = np.einsum("ijk,ijk->ij", finite, np.nan_to_num(results.values))
    means = safe_ratio(total, count)
    if np.isnan(diverged):
        return means
    return np.where(count < weight.sum(axis=2), diverged, means)


def safe_ratio(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """`total / count`, and NaN where `count` is zero."""
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def resamples(results: ResultArray, count: int | None = None, seed: int = 0) -> Iterator[Weights]:
    """Bootstrap draws of trajectories within fabric and motion, of repeats within configuration
    and fabric.

    `count` is `DRAWS` unless given, and for a `LARGE` array fewer, but at least `FEWEST_DRAWS`. A
    group of one is always itself: one repeat does not tell how repeats vary.
    """
    generator = np.random.default_rng(seed)
    groups = _numbered((t.fabric, t.evaluated_on) for t in results.trajectories)
    fabrics = _numbered(t.fabric for t in results.trajectories)
    members = [np.flatnonzero(groups == g) for g in range(groups.max(initial=-1) + 1)]
    # How many repeats each configuration has of each fabric.
    known = np.zeros((len(results.configurations), fabrics.max(initial=-1) + 1), int)
    for fabric in range(known.shape[1]):
        known[:, fabric] = results.present[:, fabrics == fabric].any(axis=1).sum(axis=1)
    slots = np.arange(results.values.shape[2])
    fewer = min(DRAWS, max(FEWEST_DRAWS, DRAWS * LARGE // max(1, results.values.size)))
    for _ in range(fewer if count is None else count):
        trajectory = np.zeros(len(results.trajectories))
        for group in members:
            np.add.at(trajectory, generator.choice(group, len(group)), 1.0)
        drawn = generator.integers(0, np.maximum(known, 1)[..., None], (*known.shape, len(slots)))
        used = slots < known[..., None]
        repeat = ((drawn[..., None] == slots) & used[..., None]).sum(axis=2, dtype=float)
        yield Weights(trajectory, repeat[:, fabrics])


def _numbered(keys: Iterable[object]) -> Integer[np.ndarray, " key"]:
    """The number of each key in the order of first appearance."""
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], int)
