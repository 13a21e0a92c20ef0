"""What the functions that make the report find in made-up studies, against what is there."""

from typing import NamedTuple

import numpy as np
from _made_up import Effects, Size, Spread, made_up
from jaxtyping import Float

from r2s.evaluation.crossed import interval
from r2s.evaluation.statistics import SIGNIFICANCE
from r2s.study.statistics.conclusions import LIFTING, WIND
from r2s.study.statistics.distances import mean_over_fabrics, means
from r2s.study.statistics.findings import find_in
from r2s.study.statistics.result_array import ResultArray, by_motion

FLOOR, ABOVE, DEFAULTS = 2e-3, 30e-3, 0.3  # [m], [m], and of its logarithm between fabrics
ALONE = Spread(*(0.0,) * len(Spread._fields))


class Measured(NamedTuple):
    """Shares of studies, or of all their comparisons, [-].

    - `any_false`: studies with a significant comparison of what is alike, after Holm's correction.
    - `false`: comparisons of what is alike that are significant alone, `worst`: of the worst one.
    - `told`, `told_alone`: comparisons of what differs that are significant the right way, after
      Holm's correction, and alone; NaN where nothing differs.
    - `held`: intervals of ratios that hold the truth. `means_held`: those of mean distances.
    - `skills_held`: those of skills, beside defaults that vary between fabrics.
    """

    any_false: float
    false: float
    worst: float
    told: float
    told_alone: float
    held: float
    means_held: float
    skills_held: float


def effects_of(size: Size, ratio: float) -> Effects:
    """Effects by which folding is better, and lifting is but for folding, [-]."""
    found = {
        (c, motion): np.log(ratio) * (motion != "folding")
        for c in size.configurations
        for motion in size.motions
    }
    for motion in size.motions:
        found[LIFTING if motion == "folding" else WIND, motion] += np.log(ratio)
    return found


def measure(size: Size, spread: Spread, ratio: float, studies: int, seed: int = 0) -> Measured:
    """What is found in so many studies, of which each has its own seed."""
    effects = effects_of(size, ratio) if ratio > 1 else {}
    truth = _truth(size, effects)
    found = []
    for i in range(studies):
        results = made_up(size, spread, effects, seed + i)
        own = results, spread, effects
        found.append((*_scores(results, truth), _means_held(*own), _skills_held(*own, seed + i)))
    p, corrected, held, right, means_held, skills_held = (
        np.array(each) for each in zip(*found, strict=True)
    )
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
        means_held=float(means_held.mean()),
        skills_held=float(skills_held.mean()),
    )


def _truth(size: Size, effects: Effects) -> Float[np.ndarray, " comparison"]:
    """The logarithm of each comparison's ratio where nothing varies."""
    verdicts = find_in(made_up(size, ALONE, effects, 0), {})
    found = np.array([c.found.mean for verdict in verdicts for c in verdict.claim.comparisons])
    return np.nan_to_num(found)  # deviations, of which there are none then, are alike


def _scores(
    results: ResultArray, truth: Float[np.ndarray, " comparison"]
) -> tuple[np.ndarray, ...]:
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


def _means_held(results: ResultArray, spread: Spread, effects: Effects) -> list[bool]:
    """Whether the interval of each configuration's mean distance on each motion holds the truth."""
    held = []
    for motion, part in by_motion(results).items():
        found = means(part)
        truth = [spread.mean * np.exp(effects.get((c, motion), 0.0)) for c in part.configurations]
        held += ((found.low <= truth) & (truth <= found.high)).tolist()
    return held


def _skills_held(results: ResultArray, spread: Spread, effects: Effects, seed: int) -> list[bool]:
    """Whether the interval of each configuration's skill in each motion holds the truth.

    A fabric's default is drawn without regard to its errors, so that the mean skill is that of the
    mean distance beside the mean of one over what default and floor differ by.
    """
    names = list(dict.fromkeys(each.fabric for each in results.trajectories))
    generator = np.random.default_rng([seed, 1])
    above = ABOVE * np.exp(DEFAULTS * generator.normal(size=len(names)))
    mean = float(np.exp(DEFAULTS**2 / 2)) / ABOVE  # of one over it
    held = []
    for motion, part in by_motion(results).items():
        whose = np.array([above[names.index(each.fabric)] for each in part.trajectories])
        told = 1 - (part.values - FLOOR) / whose[:, None]
        for c, values in zip(part.configurations, told, strict=True):
            distance = spread.mean * np.exp(effects.get((c, motion), 0.0))
            low, high = interval(mean_over_fabrics(part, values))
            held.append(bool(low <= 1 - (distance - FLOOR) * mean <= high))
    return held
