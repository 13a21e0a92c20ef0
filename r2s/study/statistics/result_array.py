"""The rows of one metric as an array: configuration by trajectory by repeat.

A trajectory is one judged recording. A repeat is one of several estimates of a configuration, which
is judged on all trajectories of its fabric. Fabrics are moved alike, to judge by and to estimate
from: trajectories that bear one number, and repeats that do, are crossed with fabrics.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.rows import Row


class Trajectory(NamedTuple):
    """One judged recording."""

    fabric: str
    evaluated_on: str
    recording: str

    @property
    def movement(self) -> str:
        """What recordings of several fabrics have in common: the name without the fabric's."""
        return self.recording.replace(self.fabric, "")


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
    results: ResultArray, diverged: float = np.inf
) -> Float[np.ndarray, "configuration trajectory"]:
    """The mean over repeats, [unit]: NaN where absent.

    Where a repeat diverged the mean is `diverged`; if that is NaN, the mean is of the others.
    """
    finite = np.isfinite(results.values)
    means = safe_ratio(np.where(finite, results.values, 0.0).sum(axis=2), finite.sum(axis=2))
    if np.isnan(diverged):
        return means
    return np.where(results.diverged.any(axis=2), diverged, means)


def safe_ratio(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """`total / count`, and NaN where `count` is zero."""
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
