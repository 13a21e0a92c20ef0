"""What two motions have in common although they are out of phase: sizes, sag, speeds.

The features are the usual ones of extent and of spectra: bounding box, convex hull, and the mean
frequency of a power spectrum (its first moment over its zeroth, as of waves: Longuet-Higgins,
"On the statistical distribution of the heights of sea waves", Journal of Marine Research 11, 1952).
Each is a number of a motion, from clouds of it or from the vertices of a sheet, over the frames
that are compared. Beyond the horizon of a motion (`r2s.metrics.horizon`) these can still be
predicted.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

UNITS = {
    "width": "m",
    "depth": "m",
    "height": "m",
    "sag": "m",
    "area": "m^2",
    "speed": "m/s",
    "frequency": "1/s",
}


def features(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], times: Float[np.ndarray, " frame"]
) -> dict[str, float]:
    """Of a motion, the means over its frames.

    - `width`, `depth`, `height`: extents along x, y and z, [m].
    - `sag`: from the highest to the mean point, [m].
    - `area`: of the convex hull of the points seen from above, [m^2].
    - `speed`: root mean square of the centroid's, [m/s].
    - `frequency`: mean frequency [1/s] of the power spectrum of the centroid's velocity, all axes
      together.

    Raises `ValueError` for fewer than four frames or frames that are not evenly spaced.
    """
    steps = np.diff(times)
    if len(clouds) != len(times) or len(times) < 4:
        raise ValueError(f"needs four frames or more, got {len(clouds)} at {len(times)} times")
    if np.ptp(steps) > 1e-3 * steps.mean():
        ends = f"{steps.min():g} to {steps.max():g} s"
        raise ValueError(f"frames must be evenly spaced, got steps of {ends}")
    extents = np.array([np.ptp(cloud, axis=0) for cloud in clouds]).mean(axis=0)
    centroids = np.array([cloud.mean(axis=0) for cloud in clouds])
    velocity = np.diff(centroids, axis=0) / steps.mean()
    power = np.sum(np.abs(np.fft.rfft(velocity, axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(velocity), steps.mean())
    total = power.sum()
    return {
        "width": float(extents[0]),
        "depth": float(extents[1]),
        "height": float(extents[2]),
        "sag": float(np.mean([cloud[:, 2].max() - cloud[:, 2].mean() for cloud in clouds])),
        "area": float(np.mean([_area(cloud[:, :2]) for cloud in clouds])),
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
