"""The conclusions of the paper (Ru et al. 2025) as hypotheses about our rows.

Each is a function of the distances on the three unseen motions, and of the paper's tables, whose
averages are quoted where the user has them. The conclusions follow from these averages, from what
is best in them, and from the paper's words on DiffCP (unstable gradients, exploding losses) and
PhysNet.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from r2s.study.configuration import APPROACHES, PAPER_CONFIGURATIONS, Configuration
from r2s.study.statistics.hypotheses import Claim, Comparison, compare, compared
from r2s.study.statistics.paper import METRICS, Paper, average
from r2s.study.statistics.result_array import (
    ResultArray,
    on_motion,
    safe_ratio,
    select,
)
from r2s.study.statistics.samples import by_movement, finite_mean, log_distances, of_fabrics

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
    """DiffCP's estimates diverge more often than others, in the share of each fabric's estimates.

    An estimate counts as diverged when a motion that it predicts did. Gradients that exploded on
    the way to a fabric that can be simulated are not seen here.
    """
    del paper  # no numbers of it there
    words, claim = (
        "share of the estimates that diverged, less that of other approaches",
        "The gradients of DiffCP explode: more of its estimates diverge than of others.",
    )
    (lost, lost_other), (made, made_other) = _diverged_estimates(results, "diffcp")
    if not (made.any() and made_other.any()):
        which = "of DiffCP" if not made.any() else "of other approaches"
        return Claim(claim, (Comparison(words, lacking=f"no rows {which}"),))
    note = (
        f"Diverged: {lost.sum():.0f} of {made.sum():.0f} estimates of DiffCP, "
        f"{lost_other.sum():.0f} of {made_other.sum():.0f} others."
    )
    if not (lost.any() or lost_other.any()):
        lacking = "no estimate diverged, and what gradients did on the way is not in the rows"
        return Claim(claim, (Comparison(words, lacking=lacking),), note)
    numbers = safe_ratio(lost, made) - safe_ratio(lost_other, made_other)
    tested = compared(words, numbers, is_ratio=False)
    # Counts may be alike in all fabrics by chance: fabrics differ at least by what counts do.
    share = (lost + lost_other).sum() / (made + made_other).sum()
    counted = share * (1 - share) * float(np.mean(1 / made[made > 0]))
    spread = max(tested.found.spread, np.sqrt(counted))
    found = tested.found._replace(spread=float(spread))
    return Claim(claim, (replace(tested, found=found),), note)


def _diverged_estimates(
    results: ResultArray, approach: str
) -> tuple[Float[np.ndarray, "side fabric"], Float[np.ndarray, "side fabric"]]:
    """How many estimates diverged, and were made: of an approach, and of all others."""
    shape = 2, len(results.fabrics)
    lost, made = np.zeros(shape), np.zeros(shape)
    for i, configuration in enumerate(results.configurations):
        if not configuration.approach:
            continue
        side = 0 if configuration.approach == approach else 1
        for place, fabric in enumerate(results.fabrics):
            own = results.of_fabric(fabric)
            lost[side, place] += results.diverged[i, own].any(axis=0).sum()
            made[side, place] += results.present[i, own].any(axis=0).sum()
    return lost, made


def physnet_varies_most(results: ResultArray, paper: Paper) -> Claim:
    """Repeats of PhysNet differ more than those of each other approach.

    Compared is the deviation over repeats of the logarithm of the distance, on the trajectories of
    both; of several configurations of an approach the geometric mean.
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
    if "physnet" not in {configuration.approach for configuration in results.configurations}:
        return Comparison(words, lacking="no rows of PhysNet")
    (first, lost), (second, lost_too) = (_log_spread(results, a) for a in (other, "physnet"))
    found = second - first
    if not np.isfinite(found).any():
        return Comparison(words, lacking="no trajectory with two or more repeats of both")
    return compared(
        words, of_fabrics(results, found), (by_movement(results, found),), (lost, lost_too)
    )


def _log_spread(
    results: ResultArray, approach: str
) -> tuple[Float[np.ndarray, " trajectory"], int]:
    """The logarithm of the deviation over repeats of the log distance, the mean of an approach's
    configurations, and how many runs diverged.

    NaN where there are fewer than two repeats, where one diverged, and where all are alike.
    """
    part = select(results, lambda configuration: configuration.approach == approach)
    values = np.where(part.values > 0, part.values, np.nan)
    logs, count = np.log(values), part.present.sum(axis=2)
    around = logs - finite_mean(logs, 2)[..., None]
    squares = np.where(np.isfinite(around), around, 0.0) ** 2
    variance = safe_ratio(squares.sum(axis=2), count - 1)
    is_known = (variance > 0) & ~part.diverged.any(axis=2)
    deviation = np.log(np.where(is_known, variance, np.nan)) / 2
    return finite_mean(deviation, 0), int(part.diverged.sum())


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
    part = select(results, lambda c: bool(c.approach), lambda t: t.evaluated_on in (easy, hard))
    if not (part.configurations and part.trajectories):
        return Comparison(words, lacking="nothing that both were judged on", paper=quoted)
    is_hard = np.array([t.evaluated_on == hard for t in part.trajectories])
    logs = log_distances(part).swapaxes(1, 2)
    numbers, of_repeats = (
        of_fabrics(part, np.where(is_hard, values, np.nan))
        - of_fabrics(part, np.where(is_hard, np.nan, values))
        for values in (finite_mean(logs, 1), logs)
    )  # (configuration, fabric) and (configuration, repeat, fabric)
    place = {name: i for i, name in enumerate(part.fabrics)}
    of_trajectory = [place[t.fabric] for t in part.trajectories]
    used = np.where(np.isfinite(numbers[:, of_trajectory]), finite_mean(logs, 1), np.nan)
    of_movement = finite_mean(used, 0)
    lost = part.diverged.sum(axis=(0, 2))
    return compared(
        words,
        finite_mean(numbers, 0),
        (
            by_movement(part, np.where(is_hard, of_movement, np.nan)),
            by_movement(part, np.where(is_hard, np.nan, of_movement)),
            finite_mean(of_repeats, 0).T,
        ),
        (int(lost[~is_hard].sum()), int(lost[is_hard].sum())),
        quoted,
    )
