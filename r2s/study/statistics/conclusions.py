"""The conclusions of the paper (Ru et al. 2025) as hypotheses about our rows.

Each is a function of the distances on the three unseen motions, and of the paper's tables, whose
averages are quoted where the user has them. The conclusions follow from these averages, from what
is best in them, and from the paper's words on DiffCP (unstable gradients, exploding losses) and
PhysNet.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from r2s.evaluation.statistics import LEVEL
from r2s.study.configuration import APPROACHES, PAPER_CONFIGURATIONS, Configuration
from r2s.study.statistics.hypotheses import Claim, Comparison, compare, paired
from r2s.study.statistics.paper import METRICS, Paper, average
from r2s.study.statistics.result_array import (
    ResultArray,
    Weights,
    mean_over_repeats,
    on_motion,
    safe_ratio,
    select,
)

LIFTING, WIND, DIFFCP = PAPER_CONFIGURATIONS[:3]
PINN_POINTS, PINN_CLOTH = PAPER_CONFIGURATIONS[6:]


def folding_is_reproduced_best(results: ResultArray, paper: Paper) -> Claim:
    """Folding is reproduced better than fling and shaking, by the same configuration and fabric."""
    there = [c for c in PAPER_CONFIGURATIONS if c in results.configurations]
    comparisons = tuple(
        _easier(results, "folding", motion, _quoted(paper, there, there, "folding", motion))
        for motion in ("fling", "shaking")
    )
    return Claim("Folding is reproduced far better than fling and shaking.", comparisons)


def cloth_is_better_in_shaking(results: ResultArray, paper: Paper) -> Claim:
    """In shaking the cloth beats the points, where an approach was run on both."""
    comparison = _solvers(results, paper, "shaking", better="cloth", worse="points")
    return Claim("In shaking the cloth solver is better than material points.", (comparison,))


def points_are_better_in_fling(results: ResultArray, paper: Paper) -> Claim:
    """In fling the points beat the cloth, PINN and DiffCP on points above all."""
    best, cloth = (PINN_POINTS, DIFFCP), [c for c in PAPER_CONFIGURATIONS if c.solver == "cloth"]
    comparisons = (
        _solvers(results, paper, "fling", better="points", worse="cloth"),
        compare(
            "PINN and DiffCP on points, against all on cloth",
            on_motion(results, "fling"),
            best,
            [c for c in cloth if c in results.configurations] or cloth,
            _quoted(paper, best, cloth, "fling"),
        ),
    )
    return Claim("In fling material points are better than the cloth solver.", comparisons)


def lifting_beats_wind(results: ResultArray, paper: Paper) -> Claim:
    """DIFFCLOUD from lifting beats DIFFCLOUD from wind in fling and shaking, not in folding."""
    comparisons = []
    for motion in ("fling", "shaking", "folding"):
        better, worse = (WIND, LIFTING) if motion == "folding" else (LIFTING, WIND)
        words = f"{better.estimated_from} better than {worse.estimated_from} in {motion}"
        quoted = _quoted(paper, [better], [worse], motion)
        comparisons.append(compare(words, on_motion(results, motion), [better], [worse], quoted))
    return Claim(
        "For DIFFCLOUD, lifting is a better source than wind in fling and shaking, but wind in "
        "folding.",
        tuple(comparisons),
    )


def pinn_on_cloth_is_best_in_folding(results: ResultArray, paper: Paper) -> Claim:
    """PINN on the cloth beats each other configuration of the paper in folding."""
    return _best(results, paper, PINN_CLOTH, "folding")


def pinn_on_points_is_best_in_fling(results: ResultArray, paper: Paper) -> Claim:
    """PINN on points beats each other configuration of the paper in fling."""
    return _best(results, paper, PINN_POINTS, "fling")


def diffcp_explodes(results: ResultArray, paper: Paper) -> Claim:
    """DiffCP's estimates diverge more often than others: Fisher's exact test of the counts.

    An estimate counts as diverged when a motion that it predicts did. Gradients that exploded on
    the way to a fabric that can be simulated are not seen here.
    """
    del paper  # no numbers of it there
    words, claim = (
        "estimates that diverged, against other approaches",
        "The gradients of DiffCP explode: more of its estimates diverge than of others.",
    )
    (lost, lost_other), (made, made_other) = _diverged_estimates(results, "diffcp")
    if not (made and made_other):
        which = "of DiffCP" if not made else "of other approaches"
        return Claim(claim, (Comparison(words, lacking=f"no rows {which}"),))
    note = f"Diverged: {lost} of {made} estimates of DiffCP, {lost_other} of {made_other} others."
    if not (lost or lost_other):
        lacking = "no estimate diverged, and what gradients did on the way is not in the rows"
        return Claim(claim, (Comparison(words, lacking=lacking),), note)
    counts = np.array([[lost, made - lost], [lost_other, made_other - lost_other]])
    tested: Any = stats.fisher_exact(counts)
    odds = counts + 0.5  # half an estimate more for each count, since one may be zero
    logarithm = float(np.log(odds[0, 0] * odds[1, 1] / (odds[0, 1] * odds[1, 0])))
    reach = float(stats.norm.ppf((1 + LEVEL) / 2) * np.sqrt((1 / odds).sum()))
    ratio, low, high = (float(np.exp(logarithm + side * reach)) for side in (0, -1, 1))
    counted = Comparison(
        f"{words} (odds ratio)",
        pairs=made + made_other,
        ratio=ratio,
        low=low,
        high=high,
        p=float(tested.pvalue),
        favoured=ratio > 1,
    )
    return Claim(claim, (counted,), note)


def _diverged_estimates(results: ResultArray, approach: str) -> tuple[list[int], list[int]]:
    """How many estimates diverged, and were made: of an approach, and of all others."""
    lost, made = [0, 0], [0, 0]
    for i, configuration in enumerate(results.configurations):
        if not configuration.approach:
            continue
        side = 0 if configuration.approach == approach else 1
        for fabric in results.fabrics:
            own = results.of_fabric(fabric)
            lost[side] += int(results.diverged[i, own].any(axis=0).sum())
            made[side] += int(results.present[i, own].any(axis=0).sum())
    return lost, made


def physnet_varies_most(results: ResultArray, paper: Paper) -> Claim:
    """Repeats of PhysNet differ more than those of each other approach.

    Compared is the deviation over repeats of the logarithm of the distance, on the trajectories of
    both. Its interval resamples trajectories alone. A repeat that diverged makes it infinite.
    """
    del paper  # no numbers of it there
    there = {configuration.approach for configuration in results.configurations}
    others = [name for name in APPROACHES if name in there and name != "physnet"]
    comparisons = [_varies_more(results, name) for name in others] or [
        Comparison("PhysNet against others", lacking="no rows of other approaches")
    ]
    return Claim("PhysNet varies most between repeats.", tuple(comparisons))


def _varies_more(results: ResultArray, other: str) -> Comparison:
    words = f"deviation between repeats: PhysNet's over {APPROACHES[other]}'s"
    first, second = _spread(results, other), _spread(results, "physnet")
    kept = np.flatnonzero((first > 0) & (second > 0))  # not where there is none
    if not len(kept):
        return Comparison(words, lacking="no trajectory with two or more repeats of both")
    with np.errstate(invalid="ignore"):  # both diverged: no difference
        found = np.log(second[kept]) - np.log(first[kept])
    found[np.isnan(found)] = 0.0
    used = {results.trajectories[i] for i in kept}
    part = select(results, trajectories=used.__contains__)

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        return found, np.ones(len(found)) if weights is None else weights.trajectory

    return paired(words, part, [t.fabric for t in part.trajectories], ratios)


def _spread(results: ResultArray, approach: str) -> np.ndarray:
    """The deviation over repeats of the log distance, the mean of an approach's configurations:
    NaN where there are fewer than two repeats."""
    own = [i for i, c in enumerate(results.configurations) if c.approach == approach]
    found = np.full((len(own), len(results.trajectories)), np.nan)
    for row, i in enumerate(own):
        for j, (values, present) in enumerate(
            zip(results.values[i], results.present[i], strict=True)
        ):
            there = values[present]
            if len(there) > 1:
                is_finite = np.isfinite(there).all()
                found[row, j] = np.std(np.log(there), ddof=1) if is_finite else np.inf
    known = ~np.isnan(found)
    return safe_ratio(np.where(known, found, 0.0).sum(axis=0), known.sum(axis=0))


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
    smaller: Sequence[Configuration],
    larger: Sequence[Configuration],
    motion: str,
    larger_on: str = "",
) -> tuple[float, float] | None:
    """The paper's averages of Chamfer distance; None where it lacks one.

    `motion`: that of `smaller`, and of `larger` too unless `larger_on` is another.
    """
    ours = average(paper, motion, METRICS["CD"], smaller)
    theirs = average(paper, larger_on or motion, METRICS["CD"], larger)
    return (ours, theirs) if np.isfinite([ours, theirs]).all() else None


def _solvers(
    results: ResultArray, paper: Paper, motion: str, better: str, worse: str
) -> Comparison:
    """One solver against the other, of the approaches and scenarios that have both."""
    pairs = [
        (configuration, other)
        for configuration in results.configurations
        if configuration.approach and configuration.solver == better
        if (other := configuration._replace(solver=worse)) in results.configurations
    ]
    both = ", ".join(c.label.replace(f" {better}", "") for c, _ in pairs)
    words = f"{better} better than {worse} in {motion}, where there are both ({both or 'none'})"
    if not pairs:
        return Comparison(words, lacking="no approach with rows of both solvers")
    in_paper = [pair for pair in pairs if set(pair) <= {*PAPER_CONFIGURATIONS}]
    quoted = _quoted(paper, [a for a, _ in in_paper], [b for _, b in in_paper], motion)
    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    return compare(words, on_motion(results, motion), first, second, quoted)


def _best(results: ResultArray, paper: Paper, best: Configuration, motion: str) -> Claim:
    comparisons = tuple(
        compare(
            f"better than {other.label}",
            on_motion(results, motion),
            [best],
            [other],
            _quoted(paper, [best], [other], motion),
        )
        for other in PAPER_CONFIGURATIONS
        if other != best
    )
    return Claim(f"In {motion} {best.label} is the best configuration.", comparisons)


def _easier(
    results: ResultArray, easy: str, hard: str, quoted: tuple[float, float] | None
) -> Comparison:
    """Distances on one motion against those on another, by the same configuration and fabric."""
    words = f"{hard} over {easy}, for the same configuration and fabric"
    part = select(results, lambda c: bool(c.approach))
    on = {m: np.array([t.evaluated_on == m for t in part.trajectories]) for m in (easy, hard)}
    where = {  # (fabric, trajectory)
        motion: np.array([part.of_fabric(f) & of_motion for f in part.fabrics]).reshape(
            len(part.fabrics), len(part.trajectories)
        )
        for motion, of_motion in on.items()
    }
    there = part.present.any(axis=2).T.astype(int)
    both = (where[easy].astype(int) @ there > 0) & (where[hard].astype(int) @ there > 0)
    fabric_of_pair = [part.fabrics[i] for i, _ in np.argwhere(both)]

    def ratios(weights: Weights | None) -> tuple[np.ndarray, np.ndarray]:
        values = mean_over_repeats(part, weights)
        counts = np.ones(values.shape[1]) if weights is None else weights.trajectory
        means = {motion: _means(values, mask * counts) for motion, mask in where.items()}
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.log(means[hard][both]) - np.log(means[easy][both])
        return np.where(np.isnan(found), 0.0, found), np.ones(len(found))

    return paired(words, part, fabric_of_pair, ratios, quoted)


def _means(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The means (fabric, configuration) of distances (configuration, trajectory), infinite where
    one diverged."""
    known = np.isfinite(values)
    means = safe_ratio(weights @ np.where(known, values, 0.0).T, weights @ known.T)
    return np.where(weights @ np.isinf(values).T > 0, np.inf, means)
