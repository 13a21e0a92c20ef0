"""Results of studies that are made up, whose effects and spreads are known.

The logarithm of a distance is a sum of what the fabric, the motion, a configuration's way with
either, its estimate and the run contribute, each drawn anew, and of an effect that is alike in all.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.matrix import PRESETS
from r2s.study.mujoco_recording import FABRIC as FLEX
from r2s.study.statistics.result_array import ResultArray, Trajectory

TYPICAL = 0.02  # [m]
Effects = Mapping[tuple[Configuration, str], float]  # by configuration and motion, [-]
AXES = "configuration", "motion", "fabric", "number", "repeat"


class Size(NamedTuple):
    """What a study has: fabrics, estimates of each, motions of each kind to judge by."""

    configurations: tuple[Configuration, ...]
    fabrics: int
    repeats: int
    judged: int
    motions: tuple[str, ...] = MOTIONS


def size_of(preset: str, motions: tuple[str, ...] = MOTIONS) -> Size:
    """The size of a preset of the study, with the motions that tell fabrics apart.

    Without the sheet of MuJoCo, which has not all configurations, and so is in no comparison.
    """
    plan = PRESETS[preset]
    ours = tuple(c for c in PAPER_CONFIGURATIONS if c in plan.configurations)
    fabrics = sum(fabric != FLEX for fabric in plan.fabrics)
    return Size(ours, fabrics, plan.repeats, plan.judged, motions)


class Spread(NamedTuple):
    """Deviations of the logarithm of a distance, [-].

    - `fabric`: how hard a fabric is. `motion`: how hard a motion is, for all fabrics.
    - `configuration`: of one configuration from the others, on all of a fabric's motions of a kind.
    - `estimate`: of one estimate from the others of its fabric.
    - `on_motion`: of one configuration from the others on one motion, for all fabrics.
    - `on_both`: the same, on one motion of one fabric. `run`: of one simulation.
    """

    fabric: float = 0.2
    motion: float = 0.3
    configuration: float = 0.2
    estimate: float = 0.2
    on_motion: float = 0.05
    on_both: float = 0.1
    run: float = 0.1

    @property
    def mean(self) -> float:
        """The mean distance without effects, [m]."""
        return TYPICAL * float(np.exp(np.sum(np.square(self)) / 2))


# The axes along which each deviation is drawn anew, in the order of Spread.
VARY = (
    *("fabric", "motion number", "configuration motion fabric", "configuration fabric repeat"),
    *("configuration motion number", "configuration motion fabric number", " ".join(AXES)),
)


def made_up(size: Size, spread: Spread, effects: Effects, seed: int) -> ResultArray:
    """The results of one study, [m]."""
    generator = np.random.default_rng(seed)
    names = size.configurations
    shape = len(names), len(size.motions), size.fabrics, size.judged, size.repeats

    def drawn(deviation: float, axes: str) -> Float[np.ndarray, "..."]:
        own = [n if axis in axes.split() else 1 for n, axis in zip(shape, AXES, strict=True)]
        return deviation * generator.normal(size=own)

    logs = np.zeros(shape)
    for deviation, axes in zip(spread, VARY, strict=True):
        logs += drawn(deviation, axes)
    for (configuration, motion), effect in effects.items():
        logs[names.index(configuration), size.motions.index(motion)] += effect
    trajectories = tuple(
        Trajectory(f"fabric{fabric}", motion, f"{motion}_fabric{fabric}_u{number}")
        for motion in size.motions
        for fabric in range(size.fabrics)
        for number in range(size.judged)
    )
    values = TYPICAL * np.exp(logs).reshape(len(names), -1, size.repeats)
    return ResultArray("chamfer", "m", names, trajectories, values, np.ones(values.shape, bool))
