"""What of the recordings does not fit the fabric that was found, by name.

Nothing that was recorded is left out silently: `left_out` says how much lies beyond the scale of
the loss, three times what is usual, and counts for little or nothing; `misfits` which marker lies
elsewhere than the sheet, which force another sheet would have, and what was written down of an
experiment that the estimate had to bend.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from r2s.estimation.estimate import Misfit
from r2s.estimation.gauss_newton import Problems
from r2s.estimation.normal_equations import marker_distances, point_distances
from r2s.estimation.nuisances import free
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import Problem
from r2s.metrics.losses import robust_weight

STRAY, FEWEST = 5.0, 4  # times the other markers' distance; markers that are needed to say so
LEAST = 2e-3  # [m], nearer than which no marker is on another cloth: ten times what trackers err
LATE = 1 / 3  # of the frames, the last ones, in which one that was lost on the way strays
BENT = 3.0  # standard deviations of what was known
FORCE, FAR_OFF = "force", 1 / 3  # of its size, root mean square: beyond is another sheet's
LITTLE = 0.25  # weight below which something is left out: that of what lies beyond the scale


def misfits(
    problems: Problems, theta: Float[Array, " theta"], predicted: Sequence[Prediction]
) -> tuple[Misfit, ...]:
    """The markers that stray, the forces that are missed and the nuisances that are bent, of all
    recordings.

    - `predicted`: of each recording at `theta`, the end of an estimate.

    A marker strays when the median of its distances, over all frames or over the last third, is
    `STRAY` times that of the median marker and at least `LEAST`; of fewer than `FEWEST` nothing is
    said. A force is missed when it differs by `FAR_OFF` of its size. A nuisance is bent when it
    ended more than `BENT` of its prior standard deviations away from what was written down.
    """
    pairs = list(enumerate(zip(problems, predicted, strict=True)))
    found = [stray for which, pair in pairs for stray in _strays(which, *pair)]
    found += [missed for which, pair in pairs for missed in _missed(which, *pair)]
    for each in free(problems):
        off = abs(float(theta[each.place]))
        if off > BENT:
            found.append(Misfit(each.recording, each.name, off, "standard deviations"))
    return tuple(found)


def left_out(
    problems: Problems, predicted: Sequence[Prediction], scale: float
) -> tuple[float, ...]:
    """Of each recording the share [-] of points or markers that lies beyond the scale of the loss.

    - `scale`: [m], see `r2s.metrics.losses.robust`: what lies there counts for a quarter of what
      lies near.
    """
    shares = []
    for problem, seen in zip(problems, predicted, strict=True):
        distance, mask = marker_distances(problem, seen) or point_distances(problem, seen, scale)
        is_out = np.asarray(robust_weight(distance, scale) < LITTLE)[np.asarray(mask)]
        shares.append(float(is_out.mean()) if is_out.size else 0.0)
    return tuple(shares)


def _strays(which: int, problem: Problem, seen: Prediction) -> list[Misfit]:
    pair = marker_distances(problem, seen)
    if pair is None:
        return []
    distance = np.where(np.asarray(pair[1]), np.asarray(pair[0], np.float64), np.nan)
    late = distance[round((1 - LATE) * len(distance)) :]
    strays: dict[int, float] = {}
    for frames in (distance, late):
        known = np.flatnonzero(~np.isnan(frames).all(axis=0))
        if len(known) < FEWEST:
            continue
        typical = np.nanmedian(frames[:, known], axis=0)
        limit = max(STRAY * float(np.median(typical)), LEAST)
        for marker, away in zip(known.tolist(), typical.tolist(), strict=True):
            if away > limit:
                strays[marker] = max(away, strays.get(marker, 0.0))
    return [Misfit(which, f"marker {each}", away, "m") for each, away in sorted(strays.items())]


def _missed(which: int, problem: Problem, seen: Prediction) -> list[Misfit]:
    if problem.force is None or seen.force is None:
        return []
    is_seen = np.asarray(problem.force.seen)
    recorded, simulated = (
        np.asarray(each, np.float64)[is_seen] for each in (problem.force.values, seen.force)
    )
    size = np.sqrt(np.mean(recorded**2))
    off = float(np.sqrt(np.mean((simulated - recorded) ** 2)) / size) if size > 0 else 0.0
    return [Misfit(which, FORCE, off, "of its size")] if off > FAR_OFF else []
