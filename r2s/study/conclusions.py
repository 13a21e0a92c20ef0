"""The conclusions of the paper (Ru et al. 2025) as comparisons of our results, and its tables.

The conclusions follow from the averages of the paper's tables, from what is best in them, and from
its words on DiffCP (unstable gradients, exploding losses) and PhysNet. Its numbers are not part of
this package: they are in a folder that the user has, with `folding.csv`, `fling.csv` and
`shaking.csv`. The header of these is `metric,fabric` and then one name for each configuration, such
as `diffcloud-diffsim-lifting`; `metric` is CD or HD.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.study.comparisons import Comparison, compare, compared, judge
from r2s.study.configuration import APPROACHES, MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.results import configurations

LIFTING, WIND, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]
CITED = "Ru et al. 2025, tables"
SOLVERS = {"diffsim": "cloth", "difftaichi": "mpm"}
CHAMFER, HAUSDORFF = "paper_chamfer", "paper_hausdorff"
METRICS = {"CD": CHAMFER, "HD": HAUSDORFF}
COLUMNS = ["evaluated_on", "metric", "fabric", "configuration", "value"]


def findings(results: pd.DataFrame, paper: pd.DataFrame) -> pd.DataFrame:
    """The answers to all conclusions (`comparisons.judge`), by labelled results of one metric;
    estimates by published recipes do not count."""
    is_own = ~results.approach.str.endswith("-published") & (results.approach != "")
    own = results[is_own & (results.baseline == "") & results.evaluated_on.isin(MOTIONS)]
    return judge(
        (words, comparison)
        for words, comparisons in _conclusions(own, paper)
        for comparison in comparisons
    )


def _conclusions(
    results: pd.DataFrame, paper: pd.DataFrame
) -> Iterator[tuple[str, list[Comparison]]]:
    def sides(motion: str, smaller: Sequence[Configuration], *larger: Configuration) -> Comparison:
        return _sides(results, paper, motion, smaller, larger)

    known = configurations(results)
    cloth = [c for c in PAPER_CONFIGURATIONS if c.solver == "cloth"]
    yield (
        "Folding is reproduced far better than fling and shaking.",
        [_easier(results, paper, "folding", motion) for motion in ("fling", "shaking")],
    )
    yield (
        "In shaking the cloth solver is better than material points.",
        [_solvers(results, paper, "shaking", "cloth", "mpm")],
    )
    yield (
        "In fling material points are better than the cloth solver.",
        [
            _solvers(results, paper, "fling", "mpm", "cloth"),
            sides("fling", (PINN_POINTS, DIFFCP), *([c for c in cloth if c in known] or cloth)),
        ],
    )
    yield (
        "For DIFFCLOUD, lifting is a better source than wind in fling and shaking, but wind in "
        "folding.",
        [
            sides("fling", [LIFTING], WIND),
            sides("shaking", [LIFTING], WIND),
            sides("folding", [WIND], LIFTING),
        ],
    )
    for best, motion in ((PINN_CLOTH, "folding"), (PINN_POINTS, "fling")):
        yield (
            f"In {motion} {best.label} is the best configuration.",
            [sides(motion, [best], other) for other in PAPER_CONFIGURATIONS if other != best],
        )
    yield (
        "The gradients of DiffCP explode: more of its estimates diverge than of others.",
        [_diverges_more(results, "diffcp")],
    )
    others = [name for name in APPROACHES if name != "physnet" and (results.approach == name).any()]
    yield (
        "PhysNet varies most between repeats.",
        [_varies_more(results, "physnet", name) for name in others]
        or [Comparison("PhysNet against others", lacking="no rows of other approaches")],
    )


def _sides(
    results: pd.DataFrame,
    paper: pd.DataFrame,
    motion: str,
    smaller: Sequence[Configuration],
    larger: Sequence[Configuration],
) -> Comparison:
    """Configurations against others on one motion, with the averages of the paper."""
    first, second = ([c.label for c in side] for side in (smaller, larger))
    words = f"in {motion} {' and '.join(first)} better than {' and '.join(second)}"
    quoted = average(paper, motion, smaller), average(paper, motion, larger)
    part = results[results.evaluated_on == motion]
    return compare(words, part, first, second)._replace(paper=quoted)


def _solvers(
    results: pd.DataFrame, paper: pd.DataFrame, motion: str, better: str, worse: str
) -> Comparison:
    """One solver against the other, of the approaches and scenarios that have both."""
    known = configurations(results)
    first = [c for c in known if c.solver == better and c._replace(solver=worse) in known]
    if not first:
        words = f"in {motion} {better} better than {worse}"
        return Comparison(words, lacking="no approach with rows of both solvers")
    return _sides(results, paper, motion, first, [c._replace(solver=worse) for c in first])


def _easier(results: pd.DataFrame, paper: pd.DataFrame, easy: str, hard: str) -> Comparison:
    """Distances on one motion against those on another, by the same configuration and fabric."""
    words = f"{hard} over {easy}, for the same configuration and fabric"
    known = [c for c in PAPER_CONFIGURATIONS if c in configurations(results)]
    quoted = average(paper, easy, known), average(paper, hard, known)
    part = results[results.evaluated_on.isin([easy, hard])]
    if part.empty:
        return Comparison(words, lacking="nothing that both were judged on", paper=quoted)
    own = ["configuration", "fabric"]
    part = part.assign(configuration=part.configuration.astype(str))
    logs = part.set_index([*own, "evaluated_on", "movement", "repeat"]).log
    of_recording = logs.groupby([*own, "evaluated_on", "movement"]).mean()

    def apart(values: pd.Series, *more: str) -> pd.Series:
        table = values.groupby([*own, *more, "evaluated_on"]).mean().unstack("evaluated_on")
        table = table.reindex(columns=[easy, hard])
        return table[hard] - table[easy]

    numbers = apart(of_recording)
    is_known = numbers.notna().reindex(of_recording.index.droplevel([2, 3])).to_numpy()
    used = of_recording[is_known].groupby(["evaluated_on", "fabric", "movement"]).mean()
    tables = [used[motion].unstack() for motion in used.index.unique("evaluated_on")]
    tables.append(apart(logs, "repeat").groupby(["fabric", "repeat"]).mean().unstack())
    counts = part.groupby("evaluated_on").diverged.sum()
    diverged = int(counts.get(easy, 0)), int(counts.get(hard, 0))
    comparison = compared(words, numbers.groupby("fabric").mean(), tables, diverged)
    return comparison._replace(paper=quoted)


def _diverges_more(results: pd.DataFrame, approach: str) -> Comparison:
    """The share of an approach's estimates that diverged minus that of others, by fabric.

    An estimate counts as diverged when a motion that it predicts did; the gradients of a search are
    not among the results.
    """
    words = "share of the estimates that diverged, less that of other approaches"
    keys = ["is_own", "fabric", "configuration", "repeat"]
    part = results.assign(is_own=results.approach == approach)
    diverged = part.groupby(keys, observed=True).diverged.any()
    counts = diverged.groupby(["is_own", "fabric"]).agg(["sum", "size"])
    sides = [counts[counts.index.get_level_values("is_own") == side] for side in (True, False)]
    if any(side.empty for side in sides):
        return Comparison(words, lacking=f"no rows {'of others' if len(sides[0]) else 'of DiffCP'}")
    words += ": " + ", ".join(f"{s['sum'].sum()} of {s['size'].sum()}" for s in sides)
    if not diverged.any():
        why = "no estimate diverged, and the gradients of searches are not in the results"
        return Comparison(words, lacking=why)
    own, others = (side.droplevel("is_own") for side in sides)
    numbers = own["sum"] / own["size"] - others["sum"] / others["size"]
    tested = compared(words, numbers, is_ratio=False)
    # counts may agree in all fabrics by chance, so the spread is at least that of counts
    chance = np.sqrt(diverged.mean() * (1 - diverged.mean()) * np.mean(1 / own["size"]))
    spread = float(max(tested.effect.spread, chance))
    return tested._replace(effect=tested.effect._replace(spread=spread))


def _varies_more(results: pd.DataFrame, approach: str, other: str) -> Comparison:
    """The standard deviation between repeats of the logarithm of the distance, over that of another
    approach; of several configurations the geometric mean."""
    words = f"deviation between repeats: {APPROACHES[approach]}'s over {APPROACHES[other]}'s"
    if not (results.approach == approach).any():
        return Comparison(words, lacking=f"no rows of {APPROACHES[approach]}")
    spreads, diverged = [], []
    for name in (approach, other):
        part = results[results.approach == name]
        groups = part.groupby(["configuration", "fabric", "movement"], observed=True)
        deviation = groups.log.std().where(~groups.diverged.any())
        logs = np.log(deviation.where(deviation > 0))
        spreads.append(logs.groupby(["fabric", "movement"]).mean())
        diverged.append(int(part.diverged.sum()))
    numbers = spreads[0] - spreads[1]
    if not numbers.notna().any():
        return Comparison(words, lacking="no recording with two or more repeats of both")
    by_movement = numbers.unstack()
    return compared(words, by_movement.mean(axis=1), [by_movement], (diverged[1], diverged[0]))


def read_paper(folder: Path | str | None) -> pd.DataFrame:
    """Read the paper's three tables as one with `COLUMNS`; it is empty without a folder.

    Lines of averages are left out. Raises FileNotFoundError, or a ValueError that names the file
    and what is wrong: another header, an unknown configuration or metric, a fabric given twice, a
    value that is missing or no positive number.
    """
    tables = [] if folder is None else [_read(Path(folder), motion) for motion in MOTIONS]
    return pd.concat([pd.DataFrame(columns=COLUMNS), *tables])


def _read(folder: Path, motion: str) -> pd.DataFrame:
    path = folder / f"{motion}.csv"
    try:
        table = pd.read_csv(path, dtype=str)
        if list(table.columns[:2]) != ["metric", "fabric"] or len(table.columns) < 3:
            raise ValueError(f"expected metric,fabric,COLUMNS, found {','.join(table.columns)}")
        if unknown := set(table.metric) - set(METRICS):
            raise ValueError(f"expected the metric CD or HD, found {min(unknown)!r}")
        table = table[table.fabric != "Average"]
        if (twice := table.duplicated(["metric", "fabric"])).any():
            raise ValueError(f"{' of '.join(table[twice].iloc[0, :2])} is given twice")
        rows = table.melt(["metric", "fabric"], var_name="configuration")
        numbers = pd.to_numeric(rows.value, errors="coerce")
        if not (is_right := (numbers > 0) & np.isfinite(numbers)).all():
            metric, fabric, _, text = rows[~is_right].iloc[0]
            raise ValueError(f"{metric} of {fabric}: expected a number above zero, found {text!r}")
        labels = {name: _configuration(name).label for name in table.columns[2:]}
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return rows.assign(
        evaluated_on=motion,
        metric=rows.metric.map(METRICS),
        fabric=rows.fabric.str.strip().str.lower().str.replace(" ", "_"),
        configuration=rows.configuration.map(labels),
        value=numbers,
    )[COLUMNS]


def _configuration(name: str) -> Configuration:
    parts = name.split("-")
    if len(parts) != 3 or parts[1] not in SOLVERS:
        known = " or ".join(SOLVERS)
        raise ValueError(f"expected APPROACH-SIMULATOR-SCENARIO with {known}, found {name!r}")
    return Configuration(parts[0], SOLVERS[parts[1]], parts[2])


def average(paper: pd.DataFrame, motion: str, whose: Sequence[Configuration]) -> float:
    """The paper's mean Chamfer distance over fabrics and configurations, [-]; NaN when one is
    missing."""
    part = paper[(paper.evaluated_on == motion) & (paper.metric == CHAMFER)]
    means = part.groupby("configuration").value.mean()
    labels = [configuration.label for configuration in whose]
    if not labels or not set(labels) <= set(means.index):
        return np.nan
    return float(means[labels].mean())


def beside_paper(results: pd.DataFrame, paper: pd.DataFrame, motion: str) -> pd.DataFrame:
    """The Chamfer distances of one motion in the paper's units [-], ours beside the paper's: a
    column a configuration, a line a fabric, last their mean; infinite where a run diverged.

    `results`: labelled.
    """
    own = results[(results.metric == CHAMFER) & (results.evaluated_on == motion)]
    own = own[own.baseline.isin(("", "default"))]
    ours = own.assign(value=own.value.where(~own.diverged, np.inf)).pivot_table(
        index="fabric", columns="configuration", values="value", observed=True
    )
    part = paper[(paper.evaluated_on == motion) & (paper.metric == CHAMFER)]
    theirs = part.pivot_table(index="fabric", columns="configuration", values="value")
    theirs.columns = [f"{label}, paper" for label in theirs.columns]
    ours.columns = list(map(str, ours.columns))
    table = pd.concat([ours, theirs], axis=1)
    table.loc["mean"] = table.mean()
    return table.rename_axis("fabric").reset_index()
