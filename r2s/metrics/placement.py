"""Where a recording's cameras would have to stand for it to lie nearest to a motion.

Calibrations that nobody wrote down can cost as much as a wrong fabric. Errors before and after a
recording is placed tell the one from the other, if all that is compared is placed alike.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from r2s.metrics.distances import Cloud

FARTHEST, TURN = 0.03, 0.3  # [m] and [rad]: two deviations of what an estimate takes as in doubt
OUTLIER = 0.02  # [m], from where on distances pull less
POINTS = 300  # of a frame, that find the place


class Placement(NamedTuple):
    """A rigid motion: a `turn` [rad] about the vertical through `pivot` [m], and a `shift` [m]."""

    shift: Float[np.ndarray, "3"]
    turn: float
    pivot: Float[np.ndarray, "3"]


def moved(place: Placement, cloud: Cloud) -> Cloud:
    """A cloud [m] as it would have been recorded from there."""
    cosine, sine = np.cos(place.turn), np.sin(place.turn)
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    return (cloud - place.pivot) @ turn + place.pivot + place.shift


def nearest(real: Sequence[Cloud], simulated: Sequence[Cloud], seed: int = 0) -> Placement:
    """The one placement of all frames of a recording that brings them nearest to a motion's.

    - `real`, `simulated`: the clouds of their frames, [m].
    - `seed`: of the `POINTS` that are drawn.

    The placement moves at most `FARTHEST` [m] along each axis, and turns at most `TURN` [rad].
    Distances go from the recording to the motion; they count squared, but less beyond `OUTLIER`
    (soft L1). Raises `ValueError` for another number of frames, and for one that is empty or not
    finite.
    """
    if len(real) != len(simulated):
        raise ValueError(f"{len(real)} recorded frames, {len(simulated)} simulated ones")
    for name, clouds in (("recorded", real), ("simulated", simulated)):
        for frame, cloud in enumerate(clouds):
            if not len(cloud) or not np.all(np.isfinite(cloud)):
                raise ValueError(f"{name} frame {frame} is empty, or not finite")
    random = np.random.default_rng(seed)
    clouds = [np.asarray(cloud, float) for cloud in real]
    frames = [cloud[random.permutation(len(cloud))[:POINTS]] for cloud in clouds]
    trees = [KDTree(cloud) for cloud in simulated]
    pivot = np.mean(np.concatenate(frames), axis=0)
    bounds = np.array([FARTHEST, FARTHEST, FARTHEST, TURN])

    def at(share: np.ndarray) -> Placement:
        *shift, turn = share * bounds
        return Placement(np.array(shift), float(turn), pivot)

    def distances(share: np.ndarray) -> np.ndarray:
        pairs = zip(trees, frames, strict=True)
        return np.concatenate([tree.query(moved(at(share), frame))[0] for tree, frame in pairs])

    start = np.zeros(len(bounds))
    found = least_squares(distances, start, bounds=(-1, 1), loss="soft_l1", f_scale=OUTLIER)
    return at(found.x)
