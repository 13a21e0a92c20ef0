"""The conclusions of the study (Ru et al. 2025) as hypotheses about our rows.

Each is a function of a panel of distances on the three unseen motions, and of the study's tables,
whose averages are quoted where the user has them: it follows from them, from what is best in them,
and from the study's words on DiffCP (unstable gradients, exploding losses) and PhysNet.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from r2s.study.statistics.hypotheses import Claim, Comparison, compare, paired
from r2s.study.statistics.panel import (
    APPROACHES,
    LEVEL,
    PAPER_COLUMNS,
    Column,
    Panel,
    Weights,
    on,
    over_repeats,
    select,
)
from r2s.study.statistics.paper import METRICS, Paper, average

PINN_POINTS, PINN_CLOTH = PAPER_COLUMNS[6], PAPER_COLUMNS[7]
DIFFCP = PAPER_COLUMNS[2]


def folding_is_reproduced_best(panel: Panel, paper: Paper) -> Claim:
    """Folding is reproduced better than fling and shaking: pairs of the same column and fabric."""
    columns = [column for column in PAPER_COLUMNS if column in panel.columns]
    quoted = lambda motion: _quoted(paper, columns, columns, motions=("folding", motion))
    comparisons = tuple(
        _easier(panel, "folding", motion, quoted(motion)) for motion in ("fling", "shaking")
    )
    return Claim("Folding is reproduced far better than fling and shaking.", comparisons)


def cloth_is_better_in_shaking(panel: Panel, paper: Paper) -> Claim:
    """In shaking the cloth beats the points, where an approach was run on both."""
    comparison = _solvers(panel, paper, "shaking", better="cloth", worse="points")
    return Claim("In shaking the cloth solver is better than material points.", (comparison,))


def points_are_better_in_fling(panel: Panel, paper: Paper) -> Claim:
    """In fling the points beat the cloth, PINN and DiffCP on points above all."""
    best, cloth = (PINN_POINTS, DIFFCP), [c for c in PAPER_COLUMNS if c.solver == "cloth"]
    comparisons = (
        _solvers(panel, paper, "fling", better="points", worse="cloth"),
        compare(
            "PINN and DiffCP on points, against all on cloth",
            on(panel, "fling"),
            best,
            [column for column in cloth if column in panel.columns] or cloth,
            _quoted(paper, best, cloth, motions=("fling", "fling")),
        ),
    )
    return Claim("In fling material points are better than the cloth solver.", comparisons)


def lifting_beats_wind(panel: Panel, paper: Paper) -> Claim:
    """DIFFCLOUD from lifting beats DIFFCLOUD from wind in fling and shaking, not in folding."""
    lifting, wind = PAPER_COLUMNS[:2]
    comparisons = []
    for motion in ("fling", "shaking", "folding"):
        pair = (wind, lifting) if motion == "folding" else (lifting, wind)
        words = f"{pair[0].estimated_from} better than {pair[1].estimated_from} in {motion}"
        quoted = _quoted(paper, pair[:1], pair[1:], motions=(motion, motion))
        comparisons.append(compare(words, on(panel, motion), pair[:1], pair[1:], quoted))
    return Claim(
        "For DIFFCLOUD, lifting is a better source than wind in fling and shaking, but wind in "
        "folding.",
        tuple(comparisons),
    )


def pinn_on_cloth_is_best_in_folding(panel: Panel, paper: Paper) -> Claim:
    """PINN on the cloth beats each other column of the study in folding."""
    return _best(panel, paper, PINN_CLOTH, "folding")


def pinn_on_points_is_best_in_fling(panel: Panel, paper: Paper) -> Claim:
    """PINN on points beats each other column of the study in fling."""
    return _best(panel, paper, PINN_POINTS, "fling")


def diffcp_explodes(panel: Panel, paper: Paper) -> Claim:
    """DiffCP's estimates diverge more often than others: Fisher's exact test of the counts.

    An estimate counts as diverged when a motion that it predicts did. Gradients that exploded on
    the way to a fabric that can be simulated are not seen here.
    """
    del paper  # no numbers of it there
    words, lost, all_of = "estimates that diverged, against other approaches", [0, 0], [0, 0]
    for column, present, values in zip(panel.columns, panel.present, panel.values, strict=True):
        if not column.approach:
            continue
        side = 0 if column.approach == "diffcp" else 1
        for fabric in dict.fromkeys(t.fabric for t in panel.trajectories):
            mine = [t.fabric == fabric for t in panel.trajectories]
            made = present[mine].any(axis=0)
            lost[side] += int((present[mine] & ~np.isfinite(values[mine])).any(axis=0).sum())
            all_of[side] += int(made.sum())
    claim = "The gradients of DiffCP explode: more of its estimates diverge than of others."
    if not all(all_of):
        which = "of DiffCP" if not all_of[0] else "of other approaches"
        return Claim(claim, (Comparison(words, lacking=f"no rows {which}"),))
    note = (
        f"Diverged: {lost[0]} of {all_of[0]} estimates of DiffCP, {lost[1]} of {all_of[1]} others."
    )
    if not any(lost):
        lacking = "no estimate diverged, and what gradients did on the way is not in the rows"
        return Claim(claim, (Comparison(words, lacking=lacking),), note)
    tested: Any = stats.fisher_exact([[lost[i], all_of[i] - lost[i]] for i in (0, 1)])
    # Half an estimate is added to each count, for one may be none.
    odds = np.array([[lost[i] + 0.5, all_of[i] - lost[i] + 0.5] for i in (0, 1)])
    logarithm = float(np.log(odds[0, 0] * odds[1, 1] / (odds[0, 1] * odds[1, 0])))
    reach = float(stats.norm.ppf((1 + LEVEL) / 2) * np.sqrt((1 / odds).sum()))
    ratio, low, high = (float(np.exp(logarithm + side * reach)) for side in (0, -1, 1))
    counted = Comparison(
        f"{words} (odds ratio)", sum(all_of), ratio, low, high, float(tested.pvalue), ratio > 1
    )
    return Claim(claim, (counted,), note)


def physnet_varies_most(panel: Panel, paper: Paper) -> Claim:
    """Repeats of PhysNet differ more than those of each other approach.

    The deviation over repeats of the logarithm of the distance, on the trajectories of both; its
    interval resamples trajectories alone. A repeat that diverged makes it infinite.
    """
    del paper  # no numbers of it there
    others = [a for a in APPROACHES if any(c.approach == a for c in panel.columns)]
    comparisons = [_varies_more(panel, a) for a in others if a != "physnet"] or [
        Comparison("PhysNet against others", lacking="no rows of other approaches")
    ]
    return Claim("PhysNet varies most between repeats.", tuple(comparisons))


def _varies_more(panel: Panel, other: str) -> Comparison:
    words = f"deviation between repeats: PhysNet's over {APPROACHES[other]}'s"
    first, second = _spread(panel, other), _spread(panel, "physnet")
    kept = np.flatnonzero((first > 0) & (second > 0))  # not where there is none
    if not len(kept):
        return Comparison(words, lacking="no trajectory with two or more repeats of both")
    with np.errstate(invalid="ignore"):  # both diverged: no difference
        found = np.nan_to_num(np.log(second[kept]) - np.log(first[kept]), nan=0.0, posinf=np.inf,
                              neginf=-np.inf)  # fmt: skip
    used = {panel.trajectories[i] for i in kept}
    part = select(panel, trajectories=used.__contains__)

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        return found, np.ones(len(found)) if weights is None else weights.trajectory

    return paired(words, part, [t.fabric for t in part.trajectories], ratios)


CONCLUSIONS = (
    folding_is_reproduced_best,
    cloth_is_better_in_shaking,
    points_are_better_in_fling,
    lifting_beats_wind,
    pinn_on_cloth_is_best_in_folding,
    pinn_on_points_is_best_in_fling,
    diffcp_explodes,
    physnet_varies_most,
)


def _quoted(
    paper: Paper,
    smaller: Sequence[Column],
    larger: Sequence[Column],
    motions: tuple[str, str],
) -> tuple[float, float] | None:
    """The averages of Chamfer distance in the study's tables; None where they lack one."""
    pair = [
        average(paper, motion, METRICS["CD"], list(columns))
        for motion, columns in zip(motions, (smaller, larger), strict=True)
    ]
    return (pair[0], pair[1]) if np.all(np.isfinite(pair)) else None


def _solvers(panel: Panel, paper: Paper, motion: str, better: str, worse: str) -> Comparison:
    """One solver against the other, of the approaches and scenarios that have both."""
    pairs = [
        (column, column._replace(solver=worse))
        for column in panel.columns
        if column.approach and column.solver == better
    ]
    pairs = [pair for pair in pairs if pair[1] in panel.columns]
    both = ", ".join(c.label.replace(f" {better}", "") for c, _ in pairs)
    words = f"{better} better than {worse} in {motion}, where there are both ({both or 'none'})"
    if not pairs:
        return Comparison(words, lacking="no approach with rows of both solvers")
    sides = [column for column, _ in pairs], [column for _, column in pairs]
    in_paper = [pair for pair in pairs if set(pair) <= {*PAPER_COLUMNS}]
    quoted = _quoted(
        paper, [a for a, _ in in_paper], [b for _, b in in_paper], motions=(motion, motion)
    )
    return compare(words, on(panel, motion), *sides, quoted)


def _best(panel: Panel, paper: Paper, column: Column, motion: str) -> Claim:
    others = [other for other in PAPER_COLUMNS if other != column]
    comparisons = tuple(
        compare(
            f"better than {other.label}",
            on(panel, motion),
            (column,),
            (other,),
            _quoted(paper, (column,), (other,), motions=(motion, motion)),
        )
        for other in others
    )
    return Claim(f"In {motion} {column.label} is the best column.", comparisons)


def _easier(panel: Panel, easy: str, hard: str, quoted: tuple[float, float] | None) -> Comparison:
    """Distances on one motion against those on another, in pairs of the same column and fabric."""
    words = f"{hard} over {easy}, for the same column and fabric"
    part = select(panel, columns=lambda c: bool(c.approach))
    fabrics = list(dict.fromkeys(t.fabric for t in part.trajectories))
    where = {
        motion: np.array(
            [
                [t.fabric == f and t.evaluated_on == motion for t in part.trajectories]
                for f in fabrics
            ]
        ).reshape(len(fabrics), len(part.trajectories))
        for motion in (easy, hard)
    }
    there = part.present.any(axis=2)
    both = np.ones((len(fabrics), len(part.columns)), bool)
    for mask in where.values():
        both &= mask.astype(int) @ there.T.astype(int) > 0
    fabric_of_pair = [fabrics[i] for i, _ in np.argwhere(both)]

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        values = over_repeats(part, weights)
        counts = np.ones(values.shape[1]) if weights is None else weights.trajectory
        means = {motion: _means(values, mask * counts) for motion, mask in where.items()}
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.log(means[hard][both]) - np.log(means[easy][both])
        return np.where(np.isnan(found), 0.0, found), np.ones(len(found))

    return paired(words, part, fabric_of_pair, ratios, quoted)


def _means(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The means (fabric, column) of distances (column, trajectory), infinite where one diverged."""
    known = np.isfinite(values)
    total = weights @ np.where(known, values, 0.0).T
    count, lost = weights @ known.T, weights @ np.isinf(values).T
    means = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return np.where(lost > 0, np.inf, means)


def _spread(panel: Panel, approach: str) -> np.ndarray:
    """The deviation over repeats of the log distance, the mean of an approach's columns: NaN
    where there are fewer than two repeats."""
    mine = [i for i, column in enumerate(panel.columns) if column.approach == approach]
    found = np.full((len(mine), len(panel.trajectories)), np.nan)
    for row, i in enumerate(mine):
        for j, (values, present) in enumerate(zip(panel.values[i], panel.present[i], strict=True)):
            there = values[present]
            if len(there) > 1:
                found[row, j] = (
                    np.std(np.log(there), ddof=1) if np.isfinite(there).all() else np.inf
                )
    known = ~np.isnan(found)
    total = np.where(known, found, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
