"""The conclusions of the paper (Ru et al. 2025), tested by our results, and its tables beside ours.

A comparison has one number a fabric, the mean logarithm of the ratio of two distances, above zero
where the hypothesis is right; intervals and tests are Student's t over fabrics. A run that diverged
has no distance: nothing is concluded in favour of a side of which one did.

The conclusions follow from the averages of the paper's tables, and from what is best in them. Its
numbers are not part of this package: they are in a folder that the user has, with `folding.csv`,
`fling.csv` and `shaking.csv`. The header of these is `metric,fabric` and then one name for each
configuration, such as `diffcloud-diffsim-lifting`; the metric CD is read.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from statsmodels.stats.multitest import multipletests

from r2s.metrics.statistics import SIGNIFICANCE, CrossedMean, interval, p_value, units_needed
from r2s.study.configuration import (
    MOTIONS,
    ON_CLOTH,
    PAPER_CONFIGURATIONS,
    PUBLISHED,
    Configuration,
)
from r2s.study.results import DEFAULT, ESTIMATE, FACTORS, configurations, crossed, motions

LIFTING, WIND, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]
CITED = "Ru et al. 2025, tables"
SIMULATORS = {"cloth": "diffsim", "mpm": "difftaichi"}  # names of solvers in the paper
CHAMFER = "paper_chamfer"
MARGIN = 0.05  # an interval of the ratio within 1 +- this says that there is no difference
HOLDS, HOLDS_NOT, UNKNOWN = "holds", "does not hold", "undecided"


class Comparison(NamedTuple):
    """One test.

    - `effect`: the mean over fabrics of the logarithm of the ratio of what `words` say, above zero
      where the hypothesis is right.
    - `diverged`: runs that did, of the side that should be smaller, and of the larger.
    - `lacking`: why there is no test, or "".
    """

    words: str
    effect: CrossedMean = CrossedMean(np.nan, 0, np.nan, 0.0, np.nan)
    diverged: tuple[int, int] = (0, 0)
    lacking: str = ""


def compare(
    words: str, results: pd.DataFrame, smaller: Sequence[str], larger: Sequence[str]
) -> Comparison:
    """Compare configurations over the recordings that they share; of several on a side the
    geometric mean counts.

    `results`: labelled, of one metric. `smaller`, `larger`: labels of the configurations that are
    expected to have the smaller and the larger distances.
    """
    sides = list(dict.fromkeys((*smaller, *larger)))
    part = results.assign(configuration=results.configuration.astype(str))
    part = part[part.configuration.isin(sides)]
    if missing := [label for label in sides if not (part.configuration == label).any()]:
        return Comparison(words, lacking=f"no rows of {', '.join(missing)}")
    part = part[part.groupby("recording").configuration.transform("nunique") == len(sides)]
    logs = part.pivot(index=FACTORS, columns="configuration", values="log")
    logs = logs.reindex(columns=sides).astype(float)
    # a repeat that one side lacks is compared with the mean of that side's others
    logs = logs.fillna(logs.groupby(["fabric", "movement"]).transform("mean"))
    below, above = (logs[list(side)].mean(axis=1, skipna=False) for side in (smaller, larger))
    return _compared(
        words, above - below, *(part[part.configuration.isin(s)] for s in (smaller, larger))
    )


def _compared(
    words: str, ratios: pd.Series, smaller: pd.DataFrame, larger: pd.DataFrame
) -> Comparison:
    """The comparison of logarithms of ratios, indexed by `FACTORS`, from the rows of both sides."""
    diverged = int(smaller.diverged.sum()), int(larger.diverged.sum())
    effect, lacking = crossed(ratios), ""
    if not effect.units:
        lacking = "all of it diverged" if sum(diverged) else "nothing that both were judged on"
    return Comparison(words, effect, diverged, lacking)


def judge(comparisons: Iterable[tuple[str, Comparison]]) -> pd.DataFrame:
    """The answer to each comparison of each conclusion, after Holm's correction for all of them.

    A comparison holds where p is below `SIGNIFICANCE` in favour of it. It does not hold where p is
    against it, or where the interval of the ratio lies within `MARGIN` of 1. Columns: `conclusion`,
    `comparison`, `answer`, `lacking`, `ratio` with `low` and `high`, `p`, `p_holm`, `fabrics`;
    `needed`, `fewest`, `most`: where there is no answer, the number of fabrics that would show a
    ratio like this, at least one as far from 1 as `MARGIN`; `diverged_smaller`, `diverged_larger`.
    """
    pairs = list(comparisons)
    p = np.array([p_value(comparison.effect) for _, comparison in pairs])
    corrected, known = np.full(len(p), np.nan), np.isfinite(p)
    if known.any():
        corrected[known] = multipletests(p[known], method="holm")[1]
    level = SIGNIFICANCE / max(1, int(known.sum()))
    rows = []
    for (conclusion, comparison), own, holm in zip(pairs, p, corrected, strict=True):
        effect, needed = comparison.effect, (np.nan,) * 3
        ratio, low, high = np.exp((effect.mean, *interval(effect)))
        answer = _answer(comparison, low, high, holm)
        if answer == UNKNOWN and not comparison.lacking:
            needed = units_needed(effect, max(abs(effect.mean), np.log1p(MARGIN)), level)
        row = {
            "conclusion": conclusion,
            "comparison": comparison.words,
            "answer": answer,
            "lacking": comparison.lacking,
            "ratio": ratio,
            "low": low,
            "high": high,
            "p": own,
            "p_holm": holm,
            "fabrics": effect.units,
            **dict(zip(("needed", "fewest", "most"), needed, strict=True)),
            **dict(zip(("diverged_smaller", "diverged_larger"), comparison.diverged, strict=True)),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _answer(comparison: Comparison, low: float, high: float, p: float) -> str:
    if comparison.lacking:
        return UNKNOWN
    if 1 / (1 + MARGIN) < low and high < 1 + MARGIN and not any(comparison.diverged):
        return HOLDS_NOT
    is_favoured = comparison.effect.mean > 0
    if p < SIGNIFICANCE and not comparison.diverged[0 if is_favoured else 1]:
        return HOLDS if is_favoured else HOLDS_NOT
    return UNKNOWN


def answers(judged: pd.DataFrame) -> dict[str, str]:
    """The answer to each conclusion: it holds where all its comparisons hold, and does not as soon
    as one of them does not."""
    by_conclusion = {}
    for conclusion, own in judged.groupby("conclusion", sort=False).answer:
        decided = HOLDS if (own == HOLDS).all() else UNKNOWN
        by_conclusion[conclusion] = HOLDS_NOT if (own == HOLDS_NOT).any() else decided
    return by_conclusion


def learned(results: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Whether the errors of each configuration (`conclusion`) on each motion (`comparison`) are
    below those of the prior mean on the same solver, in the recordings that have a skill.

    This test, and not the skill against samples, says what a recording adds to the prior.
    """
    place = ["solver", "recording"]
    known = results[(results.metric == metric) & results.skill.notna()]
    middle = known[known.baseline == "middle"].set_index(place)
    own = known[known.baseline.isin((ESTIMATE, "true", ON_CLOTH))].set_index(place)
    own = own[own.index.isin(middle.index)]
    beside = middle.reindex(own.index)
    own = own.assign(ratio=beside.log - own.log).reset_index()
    pairs = []
    for motion in motions(own):
        part = own[own.evaluated_on == motion]
        for label, rows in part.groupby("configuration", observed=True):
            whose = middle[middle.index.isin(rows.set_index(place).index)]
            ratios = rows.set_index(FACTORS).ratio
            pairs.append((str(label), _compared(motion, ratios, rows, whose)))
    return judge(pairs)


def findings(results: pd.DataFrame) -> pd.DataFrame:
    """The answers to all conclusions (`judge`), by labelled results of one metric; estimates by
    published recipes do not count."""
    own = results[(results.baseline == ESTIMATE) & ~results.approach.str.endswith(PUBLISHED)]
    own = own[own.evaluated_on.isin(MOTIONS)]
    return judge((words, each) for words, comparisons in _conclusions(own) for each in comparisons)


def _conclusions(results: pd.DataFrame) -> Iterator[tuple[str, list[Comparison]]]:
    def sides(motion: str, smaller: Sequence[Configuration], *larger: Configuration) -> Comparison:
        return _sides(results, motion, smaller, larger)

    known = configurations(results)
    cloth = [c for c in PAPER_CONFIGURATIONS if c.solver == "cloth"]
    yield (
        "Folding is reproduced far better than fling and shaking.",
        [_easier(results, "folding", motion) for motion in ("fling", "shaking")],
    )
    yield (
        "In shaking the cloth solver is better than material points.",
        [_solvers(results, "shaking", "cloth", "mpm")],
    )
    yield (
        "In fling material points are better than the cloth solver.",
        [
            _solvers(results, "fling", "mpm", "cloth"),
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


def _sides(
    results: pd.DataFrame,
    motion: str,
    smaller: Sequence[Configuration],
    larger: Sequence[Configuration],
) -> Comparison:
    """Configurations against others on one motion."""
    first, second = ([c.label for c in side] for side in (smaller, larger))
    words = f"in {motion} {' and '.join(first)} better than {' and '.join(second)}"
    return compare(words, results[results.evaluated_on == motion], first, second)


def _solvers(results: pd.DataFrame, motion: str, better: str, worse: str) -> Comparison:
    """One solver against the other, of the approaches and scenarios that have both."""
    known = configurations(results)
    first = [c for c in known if c.solver == better and c._replace(solver=worse) in known]
    if not first:
        words = f"in {motion} {better} better than {worse}"
        return Comparison(words, lacking="no approach with rows of both solvers")
    return _sides(results, motion, first, [c._replace(solver=worse) for c in first])


def _easier(results: pd.DataFrame, easy: str, hard: str) -> Comparison:
    """Distances on one motion against those on another, by the same configuration and fabric."""
    first, second = (results[results.evaluated_on == motion] for motion in (easy, hard))
    # recordings of two motions have nothing in common: the first is compared with the first
    logs = [
        part.assign(movement=pd.factorize(part.movement, sort=True)[0])
        .set_index([*FACTORS, "configuration"])
        .log
        for part in (first, second)
    ]
    ratios = (logs[1] - logs[0]).groupby(FACTORS).mean()
    words = f"{hard} over {easy}, for the same configuration and fabric"
    return _compared(words, ratios, first, second)


def read_paper(folder: Path | str | None) -> pd.DataFrame:
    """The paper's Chamfer distances [-], with the columns `evaluated_on`, `fabric`,
    `configuration` and `value`; empty without a folder.

    Lines of averages are left out. Raises FileNotFoundError, or a ValueError that names the file
    and what is wrong: another header, an unknown configuration, a value that is missing or no
    positive number.
    """
    tables = [] if folder is None else [_read(Path(folder), motion) for motion in MOTIONS]
    columns = ["evaluated_on", "fabric", "configuration", "value"]
    return pd.concat([pd.DataFrame(columns=columns), *tables])


def _read(folder: Path, motion: str) -> pd.DataFrame:
    path = folder / f"{motion}.csv"
    labels = {
        f"{c.approach}-{SIMULATORS[c.solver]}-{c.estimated_from}": c.label
        for c in PAPER_CONFIGURATIONS
    }
    table = pd.read_csv(path, dtype=str)
    if list(table.columns[:2]) != ["metric", "fabric"]:
        raise ValueError(f"{path}: expected metric,fabric,..., found {','.join(table.columns)}")
    if unknown := set(table.columns[2:]) - set(labels):
        raise ValueError(f"{path}: expected {', '.join(labels)}, found {', '.join(unknown)}")
    table = table[(table.metric == "CD") & (table.fabric != "Average")].drop(columns="metric")
    rows = table.melt("fabric", var_name="configuration")
    numbers = pd.to_numeric(rows.value, errors="coerce")
    if not (is_right := (numbers > 0) & np.isfinite(numbers)).all():
        fabric, _, text = rows[~is_right].iloc[0]
        raise ValueError(f"{path}: {fabric}: expected a number above zero, found {text!r}")
    return rows.assign(
        evaluated_on=motion,
        fabric=rows.fabric.str.strip().str.lower().str.replace(" ", "_"),
        configuration=rows.configuration.map(labels),
        value=numbers,
    )


def beside_paper(results: pd.DataFrame, paper: pd.DataFrame, motion: str) -> pd.DataFrame:
    """The Chamfer distances of one motion in the paper's units [-], ours beside the paper's: a
    column a configuration, a line a fabric, last their mean; infinite where a run diverged.

    `results`: labelled.
    """
    own = results[(results.metric == CHAMFER) & (results.evaluated_on == motion)]
    own = own[own.baseline.isin((ESTIMATE, DEFAULT))]
    ours = own.assign(value=own.value.where(~own.diverged, np.inf)).pivot_table(
        index="fabric", columns="configuration", values="value", observed=True
    )
    part = paper[paper.evaluated_on == motion]
    theirs = part.pivot_table(index="fabric", columns="configuration", values="value")
    theirs.columns = [f"{label}, paper" for label in theirs.columns]
    ours.columns = list(map(str, ours.columns))
    table = pd.concat([ours, theirs], axis=1)
    table.loc["mean"] = table.mean()
    return table.rename_axis("fabric").reset_index()
