"""Search of a unit cube for the place whose answer, a vector, is nearest to a target.

Two ways choose the places:

- A Gaussian process emulates each principal component of the answers, because 80 answers of many
  numbers say more of where the target lies than 80 losses (composite Bayesian optimisation,
  Astudillo and Frazier 2019). Scikit-optimize models a scalar loss alone: so shear, friction and
  coupling are 0.05, 0.05 and 0.30 of the range off (80 simulations), by Bayesian optimisation 0.25,
  0.10 and 0.60 (44 simulations; version 0.2.0).
- Bayesian optimisation of the loss by scikit-optimize, as in the published recipe.
"""

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from r2s._util.extras import require
from r2s.estimation import checkpoint

BATCH = 4  # calls that are answered together
COMPONENTS = 10  # principal components of the answers, at most
FIRST = 0.4  # share of the calls at places of Sobol's sequence
FIRST_CALLS = 16  # the same of Bayesian optimisation, in calls
CANDIDATES = 1000  # random places anywhere, and as many around the best
CENTRES = 5  # number of the best places
WIDTHS = (0.01, 0.5)  # of the Gaussians around them, evenly on a logarithmic scale

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


def search(
    respond: Respond,
    target: Float[np.ndarray, " part"],
    dim: int,
    *,
    published: bool = False,
    num_calls: int = 80,
    shared: int = 1,
    seed: int = 0,
    path: Path | str | None = None,
    run: str = "",
    progress: Callable[[int, float], None] | None = None,
) -> Trials:
    """The trials of a search. The last is where the target most likely lies, unless `published`.

    - `respond`: gives the answers of up to `BATCH` places.
    - `published`: by Bayesian optimisation, not by an emulator of the answers.
    - `shared`: number of parts of an answer, such as frames, that share one error of the target.
    - `path`: file that stores the trials after every batch, and from which the search continues.
    - `run`: identifies this search (`r2s.estimation.checkpoint.fingerprint`).
    - `progress`: called with the number of calls and the least loss, after every batch.

    The same seed gives the same trials. Raises `ValueError` when the file is of another search or
    the emulator has fewer than `dim` + 2 calls, and `RuntimeError` when all calls fail.
    """
    if not published and num_calls < dim + 2:
        raise ValueError(f"expected at least {dim + 2} calls in {dim} dimensions, got {num_calls}")
    num_first = FIRST_CALLS if published else max(int(FIRST * num_calls), dim + 1)
    ask = _improving_places if published else partial(_likely_places, shared=shared)
    header = {"kind": "search", "run": run, "dim": dim, "calls": num_calls}
    header |= {"first": num_first, "batch": BATCH, "seed": seed}
    trials = Trials(np.zeros((0, dim)), np.zeros((0, len(target))))
    if path is not None and (stored := checkpoint.load(path, header)) is not None:
        trials = Trials(**stored)
    sequence = qmc.Sobol(dim, rng=np.random.default_rng(seed))
    first = sequence.random_base2(max(num_first - 1, 0).bit_length())[:num_first]
    while (done := len(trials.places)) < num_calls:
        if done < num_first:
            places = first[done : min(done + BATCH, num_calls)]
        else:
            generator = np.random.default_rng([seed, done])
            places = ask(trials, num_calls - done, generator)
        new = places, respond(places) - target
        trials = Trials(*(np.concatenate(pair) for pair in zip(trials, new, strict=True)))
        if path is not None:
            checkpoint.save(path, trials._asdict(), header)
        if progress is not None:
            progress(len(trials.places), float(np.nanmin(trials.losses, initial=np.inf)))
    return trials


def _likely_places(
    trials: Trials, left: int, generator: np.random.Generator, *, shared: int = 1
) -> Places:
    """At most `BATCH` places, drawn by the likelihood of the target; of `left` = 1 the most likely.

    The likelihood is from the emulator's deviation and the error of the target, which the least
    loss estimates.
    """
    known = trials.successful
    best = known.places[np.argsort(known.losses)[:CENTRES]]
    number = min(BATCH, left - 1)
    tried = np.concatenate([_candidates(best, generator) for _ in range(1 if number else 4)])
    misfit = _misfit(known, shared * known.losses.min() ** 2, tried)
    if not number:
        return tried[np.argmin(misfit)][None]
    chance = np.exp(-(misfit - misfit.min()) / 2) + 1e-12  # so that there are enough to draw
    return tried[generator.choice(len(tried), number, replace=False, p=chance / chance.sum())]


def _candidates(best: Float[np.ndarray, "centre dim"], generator: np.random.Generator) -> Places:
    """Random places of the unit cube, half of them anywhere and half around the best so far."""
    dim = best.shape[1]
    anywhere = generator.random((CANDIDATES, dim))
    low, high = np.log(WIDTHS)
    widths = np.exp(generator.uniform(low, high, (CANDIDATES, 1)))
    centres = best[generator.integers(len(best), size=CANDIDATES)]
    near = centres + widths * generator.standard_normal((CANDIDATES, dim))
    return np.concatenate([anywhere, np.clip(near, 0, 1)])


def _misfit(trials: Trials, variance: float, tried: Places) -> Float[np.ndarray, " place"]:
    """Minus twice the log-likelihood of the target at places, by an emulator of the residuals."""
    require("sklearn", "physnet", "the search")
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    smooth = ConstantKernel(1.0, (0.1, 100.0)) * RBF([1.0] * tried.shape[1], (0.2, 20.0))
    kernel = smooth + WhiteKernel(1e-2, (1e-4, 1.0))
    mean = trials.residuals.mean(axis=0)
    _, _, axes = np.linalg.svd(trials.residuals - mean, full_matrices=False)
    axes = axes[:COMPONENTS]
    components = axes @ (trials.residuals - mean).T
    total = np.zeros(len(tried))
    for component, wanted in zip(components, -axes @ mean, strict=True):
        process: Any = GaussianProcessRegressor(kernel, normalize_y=True)
        with warnings.catch_warnings():  # that a length or the noise is at its bound
            warnings.simplefilter("ignore")
            process.fit(trials.places, component)
        expected, deviation = process.predict(tried, return_std=True)
        total_variance = deviation**2 + variance
        total += (expected - wanted) ** 2 / total_variance + np.log(total_variance)
    return total


def _improving_places(trials: Trials, left: int, generator: np.random.Generator) -> Places:
    """The next places: those of the greatest expected improvement of a Gaussian process.

    The process is one of the logarithm of the losses. A call that failed counts as the worst that
    did not: a fixed penalty far above the losses would dominate the process. The `Optimizer` is
    made anew for every batch, so that a search continues from a file as if not interrupted.
    """
    require("skopt", "physnet", "Bayesian optimisation")
    from skopt import Optimizer

    worst = trials.successful.losses.max()
    losses = np.log(np.maximum(np.nan_to_num(trials.losses, nan=worst), np.finfo(float).tiny))
    optimizer = Optimizer(
        [(0.0, 1.0)] * trials.places.shape[1],
        n_initial_points=0,
        acq_func="EI",
        acq_func_kwargs={"xi": 0.0},
        random_state=int(generator.integers(2**31)),
    )
    with warnings.catch_warnings():  # that a length is at its bound, or a place was tried before
        warnings.simplefilter("ignore")
        optimizer.tell(trials.places.tolist(), losses.tolist(), fit=False)
        return np.array(optimizer.ask(min(BATCH, left)))
