"""How far motions of fabrics can be compared: error floor, predictability horizon, skill.

A motion is known up to a floor: the error of its mesh and step, and the growth of tiny differences,
such as 0.1 % of stiffness. From the horizon on, where the floor is a large share of the difference
between fabrics, motions are compared by `features`, which do not depend on the phase.
As in weather forecasts (Lorenz, "The predictability of a flow which possesses many scales of
motion", Tellus 21, 1969); the skill is that of Murphy ("Skill scores based on the mean square
error", Monthly Weather Review 116, 1988), with the floor as the perfect forecast.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import ConvexHull, QhullError

SHARE = 0.5  # of the difference between fabrics
CLEAR = 1.5  # times the floor, that the default's error must be for a skill
UNITS = {
    "width": "m",
    "depth": "m",
    "height": "m",
    "sag": "m",
    "area": "m^2",
    "speed": "m/s",
    "frequency": "1/s",
}


def floor_of(
    causes: Mapping[str, Float[np.ndarray, "member frame"]],
) -> Float[np.ndarray, " frame"]:
    """The floor [m] of every frame, from distances of ensembles from the motion, one a cause.

    The root of the sum over the (independent) causes of the squared mean over the members. A member
    that diverged (NaN) makes the floor infinite. Raises `ValueError` without any cause.
    """
    if not causes:
        raise ValueError("a floor needs a cause or more")
    members = (np.where(np.isnan(away), np.inf, away) for away in causes.values())
    means = [np.mean(away, axis=0) for away in members]
    return np.sqrt(np.sum(np.square(means), axis=0))


def horizon_of(
    times: Float[np.ndarray, " frame"],
    floor: Float[np.ndarray, " frame"],
    apart: Float[np.ndarray, "other frame"],
) -> float:
    """The first time [s] at which the floor passes `SHARE` of the difference between fabrics.

    - `times`: of the frames, [s]. `floor`: of each, [m].
    - `apart`: distances of other fabrics in the same motion, [m]; the difference is their root mean
      square over all frames, averaged over the fabrics that did not diverge (NaN).

    Infinite when it never does. Raises `ValueError` when every other fabric diverged.
    """
    apart = apart[np.isfinite(apart).all(axis=1)]
    if not len(apart):
        raise ValueError("a horizon needs another fabric that did not diverge")
    between = np.mean(np.sqrt(np.mean(np.square(apart), axis=1)))
    passed = np.flatnonzero(floor > SHARE * between)
    return float(times[passed[0]]) if len(passed) else np.inf


def within(times: Float[np.ndarray, " frame"], horizon: float) -> np.ndarray:
    """Which frames are before the horizon [s]."""
    return np.asarray(times) < horizon


def skill(error: float, default: float, floor: float) -> float:
    """(default - error) / (default - floor): 1 at the floor, 0 for the default, below it worse.

    All are means over the same frames, [m]. Minus infinity for an error that is not finite; NaN
    where the default is not clearly above the floor.
    """
    if not np.isfinite(error):
        return -np.inf
    if not default > CLEAR * floor:
        return np.nan
    return float((default - error) / (default - floor))


def features(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], times: Float[np.ndarray, " frame"]
) -> dict[str, float]:
    """Means over the time of a motion, from clouds of it or the vertices of a sheet.

    - `width`, `depth`, `height`: extents along x, y and z, [m].
    - `sag`: from the highest to the mean point, [m].
    - `area`: of the convex hull of the points seen from above, [m^2].
    - `speed`: root mean square of the centroid's, [m/s].
    - `frequency`: mean frequency [1/s] of the power spectrum of the centroid's velocity, first
      moment over zeroth (Longuet-Higgins, Journal of Marine Research 11, 1952).

    Frames count by the time around them; the centroid is a cubic between them, of which speed and
    spectrum are taken at as many even times. Raises `ValueError` for fewer than four frames or
    times that do not increase.
    """
    if len(clouds) != len(times) or len(times) < 4:
        raise ValueError(f"needs four frames or more, got {len(clouds)} at {len(times)} times")
    if not (np.diff(times) > 0).all():
        raise ValueError(f"the frames' times [s] must increase, got {times}")
    weights = np.gradient(times)
    extents = np.average([np.ptp(cloud, axis=0) for cloud in clouds], axis=0, weights=weights)
    centroids = np.array([cloud.mean(axis=0) for cloud in clouds])
    even, step = np.linspace(times[0], times[-1], len(times), retstep=True)
    velocity = np.diff(CubicSpline(times, centroids)(even), axis=0) / step
    power = np.sum(np.abs(np.fft.rfft(velocity, axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(velocity), step)
    total = power.sum()
    sags = [cloud[:, 2].max() - cloud[:, 2].mean() for cloud in clouds]
    return {
        "width": float(extents[0]),
        "depth": float(extents[1]),
        "height": float(extents[2]),
        "sag": float(np.average(sags, weights=weights)),
        "area": float(np.average([_area(cloud[:, :2]) for cloud in clouds], weights=weights)),
        "speed": float(np.sqrt(np.mean(np.sum(velocity**2, axis=1)))),
        "frequency": float(power @ frequencies / total) if total > 0 else 0.0,
    }


def differences(
    real: Sequence[np.ndarray], simulated: Sequence[np.ndarray], times: np.ndarray
) -> dict[str, float]:
    """How much the `features` of two motions differ, in their units; NaN for one that diverged."""
    if not all(np.isfinite(cloud).all() for cloud in simulated):
        return dict.fromkeys(UNITS, np.nan)
    first, second = features(real, times), features(simulated, times)
    return {name: abs(second[name] - first[name]) for name in UNITS}


def _area(points: Float[np.ndarray, "_ 2"]) -> float:
    try:
        return float(ConvexHull(points).volume)  # in the plane its area
    except QhullError:  # all on a line
        return 0.0
