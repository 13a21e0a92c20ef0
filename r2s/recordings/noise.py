"""Noise of point clouds, from the clouds alone."""

import math

import numpy as np
from scipy.spatial import KDTree

from r2s.recordings.recording import Recording, cloud

FRAMES, POINTS = 6, 300  # that are looked at
NEIGHBOURS = 16  # a patch of some mm of a dense cloud, which is nearly plane


def point_noise(recording: Recording) -> float:
    """Standard deviation [m] of points across the surface; NaN where there are too few.

    It is that from the plane through the `NEIGHBOURS` nearest points, median over points of some
    frames. The sheet's own curvature within these counts as noise.
    """
    first, last = recording.info.frames_used
    frames = np.unique(np.linspace(first, last, FRAMES).round().astype(int))
    deviations: list[float] = []
    for frame in frames:
        points = cloud(recording, int(frame)) if recording.mask[frame].any() else np.zeros((0, 3))
        if len(points) < NEIGHBOURS:
            continue
        chosen = points[:: max(1, len(points) // POINTS)]
        patches = points[KDTree(points).query(chosen, NEIGHBOURS)[1]]
        patches = patches - patches.mean(axis=1, keepdims=True)
        least = np.linalg.eigvalsh(np.einsum("pni,pnj->pij", patches, patches))[:, 0]
        # a plane through the patch takes three of its degrees of freedom
        deviations += np.sqrt(np.maximum(least, 0) / (NEIGHBOURS - 3)).tolist()
    return float(np.median(deviations)) if deviations else math.nan


def mean_distance(deviation: float) -> float:
    """The mean distance [m] from a surface that normal noise of a standard deviation [m] gives."""
    return deviation * math.sqrt(2 / math.pi)
