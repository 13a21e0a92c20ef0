"""What is estimated of the recordings along with the fabric, by name."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from r2s.estimation.estimate import Nuisance
from r2s.estimation.gauss_newton import Problems, theta_indices
from r2s.estimation.problem import OWN, SHARED, UNITS


class Free(NamedTuple):
    """A nuisance that the prior lets vary.

    - `recording`: its index, that of the first for what recordings share.
    - `name`: one of `SHARED` or `OWN`. `scale`: its prior standard deviation, in its unit.
    - `place`: in theta, which is in that deviation.
    """

    recording: int
    name: str
    scale: float
    place: int


def free(problems: Problems) -> Iterator[Free]:
    """All of them, what recordings share once."""
    told = set()
    for which, problem in enumerate(problems):
        places = theta_indices(problems, which)[problem.space.dim :]
        rows = zip((*SHARED, *OWN), problem.nuisance_prior.scales, places, strict=True)
        for name, scale, place in rows:
            if scale and place not in told:
                told.add(place)
                yield Free(which, name, float(scale), int(place))


def nuisances(problems: Problems, theta: np.ndarray, deviation: np.ndarray) -> tuple[Nuisance, ...]:
    """The nuisances that the prior lets vary, from theta and its deviation."""
    found = []
    for each in free(problems):
        number = f" {each.recording + 1}" if len(problems) > 1 else ""
        at, spread = (each.scale * float(part[each.place]) for part in (theta, deviation))
        if each.name in SHARED:  # the logarithm of a ratio
            ratio = float(np.exp(at))
            found.append(Nuisance(f"{each.name} ratio", "-", ratio, ratio * spread))
        else:
            found.append(Nuisance(each.name + number, UNITS[each.name], at, spread))
    return tuple(found)
