"""Which motions and random numbers a study's recordings have."""

from hashlib import sha256
from typing import Any

import jax.random as jr

from r2s.scenarios.standard import SIX, Experiment, draw

RECORDING = "recording.npz"
START = "start.npy"  # beside it: the shape of a hanging sheet in its first frame


def experiment_of(scenario: str, number: int, unseen: bool, seed: int) -> Experiment:
    """Motion `number` of a scenario, the same for all fabrics.

    0 is that without any numbers; others are drawn within `r2s.scenarios.standard.LIMITS`. None
    that is `unseen`, to be judged by, is one to estimate from.
    """
    if number == 0 and not unseen:
        return SIX[scenario]()
    return SIX[scenario](**numbers_of(scenario, number, unseen, seed))


def numbers_of(scenario: str, number: int, unseen: bool, seed: int) -> dict[str, float]:
    """The numbers of a motion that is drawn."""
    key = jr.fold_in(jr.key(seed), number_of(scenario))  # or scenarios would share their numbers
    key = jr.fold_in(key, 2 * number + unseen)
    return draw(scenario, 1, key=key)[0]


def pull_of(number: int, angle: float, seed: int) -> dict[str, float]:
    """Stretch and time of a pull at an `angle` [degrees] to the warp, the same for all fabrics.

    Each angle and each number has its own, drawn within `r2s.scenarios.standard.LIMITS`.
    """
    key = jr.fold_in(jr.key(seed), number_of("pull", number, float(angle)))
    return draw("stretching", 1, key=key)[0]


def number_of(*parts: Any) -> int:
    """A number below 2^31 that depends on the parts alone."""
    return int.from_bytes(sha256(repr(parts).encode()).digest()[:4], "big") >> 1
