"""The rows of a study as one array: what is compared, by trajectories, by repeats.

A trajectory is one judged recording. A repeat is one of several estimates alike, which is judged
on all trajectories of its fabric; so a bootstrap draws repeats within a column and a fabric, and
trajectories within a fabric and a motion. The fabrics themselves are given: intervals are about
these fabrics, not about others.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from r2s.study.statistics.tables import COLUMNS, Row

APPROACHES = {"diffcloud": "DIFFCLOUD", "diffcp": "DiffCP", "physnet": "PhysNet", "pinn": "PINN"}
MOTIONS = ("folding", "fling", "shaking")  # that no estimate has seen
LEVEL = 0.9  # of every interval
DRAWS, FEWEST_DRAWS = 1000, 200  # of a bootstrap
LARGE = 100_000  # values, beyond which fewer draws are made: they take as long together


class Column(NamedTuple):
    """What is compared: an approach on a solver, from a scenario.

    The default fabric on a solver has neither approach nor scenario.
    """

    approach: str
    solver: str
    estimated_from: str

    @property
    def label(self) -> str:
        if not self.approach:
            return f"default {self.solver}"
        named = APPROACHES.get(self.approach, self.approach)
        return f"{named} {self.solver} {self.estimated_from}".strip()


# The columns of the study's tables, in their order.
PAPER_COLUMNS = (
    Column("diffcloud", "cloth", "lifting"),
    Column("diffcloud", "cloth", "wind"),
    Column("diffcp", "points", "lifting"),
    Column("physnet", "cloth", "lifting"),
    Column("physnet", "cloth", "wind"),
    Column("physnet", "points", "lifting"),
    Column("pinn", "points", "stretching"),
    Column("pinn", "cloth", "stretching"),
)


class Trajectory(NamedTuple):
    """One judged recording."""

    fabric: str
    evaluated_on: str
    recording: str


class Panel(NamedTuple):
    """All values of one metric.

    - `values` [unit]: NaN where absent, and where the simulation diverged.
    - `present`: where there is a row; what is present and not finite diverged.
    """

    metric: str
    unit: str
    columns: tuple[Column, ...]
    trajectories: tuple[Trajectory, ...]
    values: Float[np.ndarray, "column trajectory repeat"]
    present: Bool[np.ndarray, "column trajectory repeat"]


class Weights(NamedTuple):
    """How often a resample has drawn each trajectory, and each repeat of its fabric."""

    trajectory: Float[np.ndarray, " trajectory"]
    repeat: Float[np.ndarray, "column trajectory repeat"]


def column_of(row: Row) -> Column | None:
    """The column of a row; None for baselines other than the default fabric."""
    if row.baseline == "default":
        return Column("", row.solver, "")
    return Column(row.approach, row.solver, row.estimated_from) if row.baseline == "" else None


def columns_of(rows: Iterable[Row]) -> tuple[Column, ...]:
    """The columns there are: those of the study's tables first, the default fabric last."""
    found = {column for row in rows if (column := column_of(row)) is not None}
    order = [*PAPER_COLUMNS, *sorted(found - {*PAPER_COLUMNS}, key=lambda c: (not c.approach, c))]
    return tuple(column for column in order if column in found)


def by_metric(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each metric."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.metric, []).append(row)
    return found


def defined(rows: Iterable[Row]) -> tuple[list[Row], dict[str, int]]:
    """Rows without those whose metric has no value for a run that did not diverge.

    That is a run of which another metric is finite. Second, how many of each metric are left out.
    """
    rows = list(rows)
    run = attrgetter(*COLUMNS[: COLUMNS.index("metric")])
    finite = {run(row) for row in rows if np.isfinite(row.value)}
    kept, left_out = [], dict[str, int]()
    for row in rows:
        if np.isfinite(row.value) or run(row) not in finite:
            kept.append(row)
        else:
            left_out[row.metric] = left_out.get(row.metric, 0) + 1
    return kept, left_out


def by_motion(panel: Panel) -> dict[str, Panel]:
    """The part of a panel that is of each unseen motion there is, in the study's order."""
    there = {trajectory.evaluated_on for trajectory in panel.trajectories}
    return {motion: on(panel, motion) for motion in MOTIONS if motion in there}


def on(panel: Panel, motion: str) -> Panel:
    """What was judged on a motion, and the columns that have it."""
    part = select(panel, trajectories=lambda t: t.evaluated_on == motion)
    judged = {c for c, there in zip(part.columns, part.present, strict=True) if there.any()}
    return select(part, judged.__contains__)


def make_panel(
    rows: Iterable[Row], metric: str, motions: Sequence[str] = MOTIONS, own: bool = False
) -> Panel:
    """The values of a metric on `motions`, or, with `own`, on what each was estimated from.

    No rows make an empty panel. Raises ValueError for two rows of one place, and several units.
    """
    chosen = [
        (column, row)
        for row in rows
        if row.metric == metric
        and (row.evaluated_on == row.estimated_from if own else row.evaluated_on in motions)
        and (column := column_of(row)) is not None
    ]
    units = sorted({row.unit for _, row in chosen}) or ["m"]
    if len(units) > 1:
        raise ValueError(f"{metric}: several units: {units}")
    columns = columns_of(row for _, row in chosen)
    where = {column: i for i, column in enumerate(columns)}
    trajectories = tuple(
        dict.fromkeys(Trajectory(r.fabric, r.evaluated_on, r.recording) for _, r in chosen)
    )
    place = {trajectory: i for i, trajectory in enumerate(trajectories)}
    number = _repeat_numbers(chosen)
    size = len(columns), len(trajectories), 1 + max(number.values(), default=-1)
    values, present = np.full(size, np.nan), np.zeros(size, bool)
    for column, row in chosen:
        trajectory = Trajectory(row.fabric, row.evaluated_on, row.recording)
        at = where[column], place[trajectory], number[column, row.fabric, row.repeat]
        if present[at]:
            what = f"{metric} of {column.label}, repeat {row.repeat}, on {row.recording}"
            raise ValueError(f"two rows for one value: {what}")
        present[at] = True
        values[at] = row.value if np.isfinite(row.value) else np.nan
    return Panel(metric, units[0], columns, trajectories, values, present)


def _repeat_numbers(chosen: Sequence[tuple[Column, Row]]) -> dict[tuple[Column, str, str], int]:
    """The repeats of a column and a fabric, numbered from 0 on."""
    names: dict[tuple[Column, str], dict[str, int]] = {}
    for column, row in chosen:
        known = names.setdefault((column, row.fabric), {})
        known.setdefault(row.repeat, len(known))
    return {(*key, name): i for key, known in names.items() for name, i in known.items()}


def select(
    panel: Panel,
    columns: Callable[[Column], bool] | None = None,
    trajectories: Callable[[Trajectory], bool] | None = None,
) -> Panel:
    """The part of a panel whose columns and trajectories pass."""
    rows = [i for i, c in enumerate(panel.columns) if columns is None or columns(c)]
    places = [
        i for i, t in enumerate(panel.trajectories) if trajectories is None or trajectories(t)
    ]
    return panel._replace(
        columns=tuple(panel.columns[i] for i in rows),
        trajectories=tuple(panel.trajectories[i] for i in places),
        values=panel.values[rows][:, places],
        present=panel.present[rows][:, places],
    )


def over_repeats(
    panel: Panel, weights: Weights | None = None, diverged: float = np.inf
) -> Float[np.ndarray, "column trajectory"]:
    """The mean over repeats, [unit]: NaN where absent.

    Where a repeat diverged the mean is `diverged`; with NaN for it, the mean is of the others. All
    repeats count of a trajectory of which none was drawn, as where each has its own estimate.
    """
    weight = panel.present * 1.0
    if weights is not None:
        drawn = weight * weights.repeat
        weight = np.where(drawn.any(axis=2, keepdims=True), drawn, weight)
    finite = weight * np.isfinite(panel.values)
    count = finite.sum(axis=2)
    total = np.einsum("ijk,ijk->ij", finite, np.nan_to_num(panel.values))
    means = np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
    if np.isnan(diverged):
        return means
    return np.where(count < weight.sum(axis=2), diverged, means)


def resamples(panel: Panel, count: int | None = None, seed: int = 0) -> Iterator[Weights]:
    """Bootstrap draws of trajectories within fabric and motion, of repeats within column, fabric.

    `count`: where not given DRAWS, of a LARGE panel fewer, at least FEWEST_DRAWS.

    A group of one is always itself: with one repeat there is no telling how repeats vary.
    """
    generator = np.random.default_rng(seed)
    groups = _numbered((t.fabric, t.evaluated_on) for t in panel.trajectories)
    fabrics = _numbered(t.fabric for t in panel.trajectories)
    members = [np.flatnonzero(groups == g) for g in range(groups.max(initial=-1) + 1)]
    known = np.stack(  # how many repeats there are: (column, fabric)
        [panel.present[:, fabrics == f].any(axis=1).sum(axis=1)
         for f in range(fabrics.max(initial=-1) + 1)], axis=1,
    ) if len(fabrics) else np.zeros((len(panel.columns), 0), int)  # fmt: skip
    slots = np.arange(panel.values.shape[2])
    fewer = min(DRAWS, max(FEWEST_DRAWS, DRAWS * LARGE // max(1, panel.values.size)))
    for _ in range(fewer if count is None else count):
        trajectory = np.zeros(len(panel.trajectories))
        for group in members:
            np.add.at(trajectory, generator.choice(group, len(group)), 1.0)
        drawn = generator.integers(0, np.maximum(known, 1)[..., None], (*known.shape, len(slots)))
        used = slots < known[..., None]
        repeat = ((drawn[..., None] == slots) & used[..., None]).sum(axis=2, dtype=float)
        yield Weights(trajectory, repeat[:, fabrics])


def interval(samples: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """The middle LEVEL of bootstrap samples, over the first axis; NaN where none is finite."""
    samples = np.asarray(samples, float)
    samples = samples[~np.isnan(samples)]
    if not len(samples):
        return np.nan, np.nan
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="nearest")
    return float(low), float(high)


def _numbered(keys: Iterable[object]) -> np.ndarray:
    """Each key as its number in the order of first appearance."""
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], int)
