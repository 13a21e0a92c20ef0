"""Search of a unit cube for the place whose answer, a vector, is nearest to a target.

Places are asked for in batches, by `r2s.estimation.physnet.emulator.ask` or
`r2s.estimation.physnet.bayes.ask`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from r2s.estimation import checkpoint

Places = Float[np.ndarray, "place dim"]
Respond = Callable[[Places], Float[np.ndarray, "place part"]]


class Trials(NamedTuple):
    """Places in the unit cube in the order of the calls, and how far their answers are off.

    - `residuals`: answers less the target; NaN where a call failed.
    """

    places: Float[np.ndarray, "call dim"]
    residuals: Float[np.ndarray, "call part"]

    @property
    def losses(self) -> Float[np.ndarray, " call"]:
        """The rms residual of each call; NaN where it failed."""
        return np.sqrt((self.residuals**2).mean(axis=1))

    @property
    def successful(self) -> "Trials":
        """The calls that did not fail. Raises `RuntimeError` when all did."""
        succeeded = np.isfinite(self.losses)
        if not succeeded.any():
            raise RuntimeError(
                f"all {len(succeeded)} calls failed: check the units of the recording and its "
                "gripper path, or narrow the ranges"
            )
        return Trials(self.places[succeeded], self.residuals[succeeded])


def minimise(
    respond: Respond,
    target: Float[np.ndarray, " part"],
    ask: Callable[[Trials, int, int, np.random.Generator], Places],
    dim: int,
    *,
    num_calls: int = 80,
    num_first: int = 16,
    batch: int = 4,
    seed: int = 0,
    path: Path | str | None = None,
    run: str = "",
    progress: Callable[[int, float], None] | None = None,
) -> Trials:
    """The trials of a search of `num_calls` calls.

    - `respond`: gives the answers of up to `batch` places.
    - `ask`: gives the places of the next calls from the trials, the most that it may give, the
      number of calls that are left, and a generator of random numbers.
    - `num_first`: calls at places of Sobol's sequence, before `ask` is used.
    - `path`: file that keeps the trials after every batch, and from which the search continues.
    - `run`: what tells this search from others (`r2s.estimation.checkpoint.fingerprint`).
    - `progress`: called with the number of calls and the least loss, after every batch.

    The same seed gives the same trials. Raises `ValueError` when the file is of another search, and
    `RuntimeError` when all calls fail.
    """
    known = {"kind": "search", "run": run, "dim": dim, "calls": num_calls}
    known |= {"first": num_first, "batch": batch, "seed": seed}
    trials = Trials(np.zeros((0, dim)), np.zeros((0, len(target))))
    if path is not None and (stored := checkpoint.load(path, known)) is not None:
        trials = Trials(**stored)
    even = qmc.Sobol(dim, rng=np.random.default_rng(seed))
    first = even.random_base2(max(num_first - 1, 0).bit_length())[:num_first]
    while (done := len(trials.places)) < num_calls:
        if done < num_first:
            places = first[done : min(done + batch, num_calls)]
        else:
            generator = np.random.default_rng([seed, done])
            places = ask(trials, batch, num_calls - done, generator)
        residuals = respond(places) - target
        trials = Trials(
            np.concatenate([trials.places, places]), np.concatenate([trials.residuals, residuals])
        )
        if path is not None:
            checkpoint.save(path, trials._asdict(), known)
        if progress is not None:
            progress(len(trials.places), float(np.nanmin(trials.losses, initial=np.inf)))
    return trials
