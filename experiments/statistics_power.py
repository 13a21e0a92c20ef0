"""Do the study's statistics keep their promise? Made-up studies with nothing, or something, in them.

python experiments/statistics_power.py --out docs/results/statistics_power.csv    # 20 minutes

Studies of the size of a preset are given to the functions that make the report. Without effects
every finding is false; with them DIFFCLOUD from lifting is better than from wind, and folding
better than fling and shaking, by a ratio.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from _made_up import Effects, Size, Spread, made_up, size_of
from _tables import Line, command_line, insert, keep, shown
from jaxtyping import Float

from r2s.evaluation.crossed import interval
from r2s.evaluation.statistics import LEVEL, SIGNIFICANCE
from r2s.study.configuration import MOTIONS
from r2s.study.statistics.conclusions import LIFTING, WIND
from r2s.study.statistics.distances import means
from r2s.study.statistics.findings import find_in
from r2s.study.statistics.result_array import by_motion

SPREADS = {
    "15 %": Spread(fabric=0.15, configuration=0.15),
    "30 %": Spread(fabric=0.3, configuration=0.3),
    "15 %, motions as much": Spread(fabric=0.15, configuration=0.15, on_motion=0.15),
}
RATIOS = (1.0, 1.5, 3.0, 10.0)
ALONE = Spread(*(0.0,) * 7)


class Measured(NamedTuple):
    """Shares of studies, or of all their comparisons, [-].

    - `any_false`: studies with a significant comparison of what is alike, after Holm's correction.
    - `false`: comparisons of what is alike that are significant alone, `worst`: of the worst one.
    - `told`, `told_alone`: comparisons of what differs that are significant the right way, after
      Holm's correction, and alone; NaN where nothing differs.
    - `held`: intervals of ratios that hold the truth. `means_held`: those of mean distances.
    """

    any_false: float
    false: float
    worst: float
    told: float
    told_alone: float
    held: float
    means_held: float


def effects_of(size: Size, ratio: float) -> Effects:
    """Effects by which folding is better, and lifting is but for folding, [-]."""
    found = {
        (c, motion): np.log(ratio) * (motion != "folding")
        for c in size.configurations
        for motion in MOTIONS
    }
    for motion in MOTIONS:
        found[LIFTING if motion == "folding" else WIND, motion] += np.log(ratio)
    return found


def measure(size: Size, spread: Spread, ratio: float, studies: int, seed: int = 0) -> Measured:
    """What is found in so many studies, of which each has its own seed."""
    effects = effects_of(size, ratio) if ratio > 1 else {}
    truth = _truth(size, effects)
    found = [_scores(made_up(size, spread, effects, seed + i), truth) for i in range(studies)]
    p, corrected, held, right = (np.array(each) for each in zip(*found, strict=True))
    alike, differs = np.abs(truth) < 1e-9, np.abs(truth) > 1e-9
    known = np.isfinite(p)
    alone = known & (p < SIGNIFICANCE)
    of_each = alone[:, alike].sum(axis=0) / np.maximum(known[:, alike].sum(axis=0), 1)
    after = known & (np.nan_to_num(corrected, nan=1.0) < SIGNIFICANCE)
    return Measured(
        any_false=float(after[:, alike].any(axis=1).mean()),
        false=float(alone[:, alike].sum() / known[:, alike].sum()),
        worst=float(of_each.max()),
        told=float((after & right)[:, differs].mean()) if differs.any() else np.nan,
        told_alone=float((alone & right)[:, differs].mean()) if differs.any() else np.nan,
        held=float(held[known].mean()),
        means_held=_means_held(size, spread, studies, seed),
    )


def _truth(size: Size, effects: Effects) -> Float[np.ndarray, " comparison"]:
    """The logarithm of each comparison's ratio where nothing varies."""
    verdicts = find_in(made_up(size, ALONE, effects, 0), {})
    found = np.array([c.found.mean for verdict in verdicts for c in verdict.claim.comparisons])
    return np.nan_to_num(found)  # deviations, of which there are none then, are alike


def _scores(results, truth: Float[np.ndarray, " comparison"]) -> tuple[np.ndarray, ...]:
    """Of each comparison: p, corrected p, and whether its interval and its sign are right."""
    verdicts = find_in(results, {})
    comparisons = [c for verdict in verdicts for c in verdict.claim.comparisons]
    ends = np.array([interval(comparison.found) for comparison in comparisons])
    return (
        np.array([comparison.p for comparison in comparisons]),
        np.array([p for verdict in verdicts for p in verdict.corrected]),
        (ends[:, 0] <= truth) & (truth <= ends[:, 1]),
        np.array([c.found.mean for c in comparisons]) * truth > 0,
    )


def _means_held(size: Size, spread: Spread, studies: int, seed: int) -> float:
    """How often the interval of a configuration's mean distance on a motion holds the truth."""
    held = []
    for i in range(studies):
        for part in by_motion(made_up(size, spread, {}, seed + i)).values():
            found = means(part)
            held.append((found.low <= spread.mean) & (spread.mean <= found.high))
    return float(np.mean(held))


def line(preset: str, words: str, ratio: float, found: Measured) -> Line:
    """The line of a table."""
    shares = {
        "studies with a false finding": found.any_false,
        "false alone": found.false,
        "the worst": found.worst,
        "effects told": found.told,
        "told alone": found.told_alone,
        "ratios held": found.held,
        "means held": found.means_held,
    }
    told = {name: f"{value:.1%}" if np.isfinite(value) else "-" for name, value in shares.items()}
    return {"preset": preset, "spread between fabrics": words, "ratio": f"{ratio:g}"} | told


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/statistics_power.csv")
    parser.add_argument("--studies", type=int, default=1000)
    parser.add_argument("--document", type=Path, help="to put the table into")
    a = parser.parse_args()
    lines = [
        line(preset, words, ratio, measure(size_of(preset), spread, ratio, a.studies))
        for preset in ("small", "paper")
        for words, spread in SPREADS.items()
        for ratio in RATIOS
    ]
    caption = (
        f"Made-up studies, {a.studies} a line: false findings at {SIGNIFICANCE:.0%}, power, and "
        f"how many intervals of {LEVEL:.0%} hold the truth."
    )
    keep(a.out, lines, caption)
    if a.document:
        insert(a.document, a.out.stem, shown(a.out))
