"""What a motion can say of a fabric: its floor, its horizon, and the skill of a prediction.

A recorded or simulated motion is known up to a floor: what its mesh and step leave, and what
differences that no one can see, such as a tenth of a per cent of stiffness, grow to. Where that
floor is a large share of what fabrics differ by, an error says nothing about a fabric: beyond this
horizon motions are compared by what does not depend on the phase (`r2s.metrics.phase_free`).
Predictability in weather forecasts is told in the same way (Lorenz, "The predictability of a flow
which possesses many scales of motion", Tellus 21, 1969); the skill is that of Murphy ("Skill scores
based on the mean square error", Monthly Weather Review 116, 1988), with the floor as the perfect
forecast.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

SHARE = 0.5  # of what fabrics differ by
CLEAR = 1.5  # times the floor, that the default's error must be for a skill to be told


def floor_of(
    causes: Mapping[str, Float[np.ndarray, "member frame"]],
) -> Float[np.ndarray, " frame"]:
    """The floor [m] of every frame, from the distances of an ensemble from the motion, by cause.

    The mean over the members of a cause, and over the causes, which are independent, the root of
    the sum of squares. A member that diverged (NaN) makes the floor infinite from there on.
    Raises `ValueError` without any cause.
    """
    if not causes:
        raise ValueError("a floor needs a cause or more")
    means = [np.mean(np.where(np.isnan(each), np.inf, each), axis=0) for each in causes.values()]
    return np.sqrt(np.sum(np.square(means), axis=0))


def horizon_of(
    times: Float[np.ndarray, " frame"],
    floor: Float[np.ndarray, " frame"],
    apart: Float[np.ndarray, "other frame"],
    share: float = SHARE,
) -> float:
    """The first time [s] at which the floor passes a share of what fabrics differ by; infinite when
    it never does.

    - `times`: of the frames, [s]. `floor`: of each, [m].
    - `apart`: distances of other fabrics in the same motion, [m]. What fabrics differ by is the
      mean over them of the root mean square over the frames, one number for the whole motion: at
      its start none differ. One that diverged (NaN) does not count.

    Raises `ValueError` when none counts.
    """
    apart = apart[np.isfinite(apart).all(axis=1)]
    if not len(apart):
        raise ValueError("a horizon needs another fabric that did not diverge")
    between = np.mean(np.sqrt(np.mean(np.square(apart), axis=1)))
    passed = np.flatnonzero(floor > share * between)
    return float(times[passed[0]]) if len(passed) else np.inf


def within(times: Float[np.ndarray, " frame"], horizon: float) -> np.ndarray:
    """Which frames are before the horizon [s]."""
    return np.asarray(times) < horizon


def skill(error: float, default: float, floor: float, clear: float = CLEAR) -> float:
    """(default - error) / (default - floor): 1 at the floor, 0 for the default, below it worse.

    All are means over the same frames, [m]. Minus infinity for an error that is not finite; NaN, so
    not told, where the default is not clearly above the floor.
    """
    if not np.isfinite(error):
        return -np.inf
    if not default > clear * floor:
        return np.nan
    return float((default - error) / (default - floor))
