"""Search for the place whose answer, a vector, is nearest to a target.

A Gaussian process emulates each principal component of the answers, because 80 answers of many
numbers say more of where the target lies than 80 losses (composite Bayesian optimisation, Astudillo
and Frazier 2019). It is our own, since scikit-optimize models a scalar loss and no vector.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.estimation import checkpoint
from r2s.estimation.physnet.bayes import CENTRES, candidates, even
from r2s.extras import require

COMPONENTS = 10  # principal components of the answers, at most
FIRST = 0.4  # share of the calls that fill the cube evenly
Respond = Callable[[Float[np.ndarray, "place dim"]], Float[np.ndarray, "place part"]]


class Trials(NamedTuple):
    """Places in the unit cube in the order of the calls, and answers; NaN where a call failed."""

    places: Float[np.ndarray, "call dim"]
    answers: Float[np.ndarray, "call part"]

    def losses(self, target: Float[np.ndarray, " part"]) -> Float[np.ndarray, " call"]:
        """The rms difference of each answer from the target."""
        return np.sqrt(((self.answers - target) ** 2).mean(axis=1))


def minimise(
    respond: Respond,
    target: Float[np.ndarray, " part"],
    dim: int,
    *,
    num_calls: int = 80,
    batch: int = 4,
    shared: int = 1,
    seed: int = 0,
    path: Path | str | None = None,
    run: str = "",
    progress: Callable[[Trials], None] | None = None,
) -> Trials:
    """Trials, of which the last is where the target most likely lies.

    - `respond`: gives the answers of up to `batch` places.
    - `shared`: number of parts of an answer, such as frames, that share one error of the target.
    - `path`: file that keeps the trials after every batch, and from which the search continues.
    - `run`: what tells this search from others (`r2s.estimation.checkpoint.fingerprint`).
    - `progress`: called with the trials after every batch.

    The share `FIRST` of the calls fills the cube. Then each batch is drawn by the likelihood of the
    target, from the emulator's deviation and the error of the target, which the least loss
    estimates. The same seed gives the same trials. Raises `ValueError` when the file is of another
    search or for fewer than `dim` + 2 calls, and `RuntimeError` when all calls fail.
    """
    if num_calls < dim + 2:
        raise ValueError(f"expected at least {dim + 2} calls in {dim} dimensions, got {num_calls}")
    told = {"kind": "emulated search", "run": run, "dim": dim}
    told |= {"calls": num_calls, "batch": batch, "seed": seed}
    trials = Trials(np.zeros((0, dim)), np.zeros((0, len(target))))
    if path is not None and (stored := checkpoint.load(path, told)) is not None:
        trials = Trials(**stored)
    first = even(dim, max(int(FIRST * num_calls), dim + 1), seed)
    while (done := len(trials.places)) < num_calls:
        if done < len(first):
            places = first[done : min(done + batch, num_calls)]
        else:
            number = min(batch, num_calls - 1 - done)
            generator = np.random.default_rng([seed, done])
            places = _ask(trials, target, shared, number, generator)
        answers = respond(places)
        known = np.concatenate([trials.answers, answers])
        trials = Trials(np.concatenate([trials.places, places]), known)
        if path is not None:
            checkpoint.save(path, trials._asdict(), told)
        if progress is not None:
            progress(trials)
    return trials


def _ask(trials: Trials, target, shared: int, number: int, generator) -> np.ndarray:
    """`number` places drawn by their likelihood; for 0, the last call, the most likely one."""
    losses = trials.losses(target)
    kept = np.isfinite(losses)
    if not kept.any():
        raise RuntimeError(
            f"all {len(losses)} calls failed: check the units of the recording and its gripper "
            "path, or narrow the ranges"
        )
    places, answers, losses = trials.places[kept], trials.answers[kept], losses[kept]
    best = places[np.argsort(losses)[:CENTRES]]
    tried = np.concatenate([candidates(best, generator) for _ in range(1 if number else 4)])
    misfit = _misfit(places, answers, target, shared * losses.min() ** 2)(tried)
    if not number:
        return tried[np.argmin(misfit)][None]
    chance = np.exp(-(misfit - misfit.min()) / 2)
    chance = chance + 1e-12  # so that there are enough to draw
    return tried[generator.choice(len(tried), number, replace=False, p=chance / chance.sum())]


def _misfit(places, answers, target, variance: float) -> Callable[[np.ndarray], np.ndarray]:
    """Minus twice the log-likelihood of the target at places, by an emulator of the answers."""
    mean = answers.mean(axis=0)
    _, _, axes = np.linalg.svd(answers - mean, full_matrices=False)
    axes = axes[:COMPONENTS]
    wanted = (target - mean) @ axes.T
    processes = [_process(places, component) for component in ((answers - mean) @ axes.T).T]

    def misfit(tried: np.ndarray) -> np.ndarray:
        total = np.zeros(len(tried))
        for process, value in zip(processes, wanted, strict=True):
            expected, deviation = process.predict(tried, return_std=True)
            total_variance = deviation**2 + variance
            total += (expected - value) ** 2 / total_variance + np.log(total_variance)
        return total

    return misfit


def _process(places: np.ndarray, values: np.ndarray) -> Any:
    """A Gaussian process fitted to one component."""
    require("sklearn", "physnet", "the search")
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    smooth = ConstantKernel(1.0, (0.1, 100.0)) * RBF([1.0] * places.shape[1], (0.2, 20.0))
    process = GaussianProcessRegressor(smooth + WhiteKernel(1e-2, (1e-4, 1.0)), normalize_y=True)
    with warnings.catch_warnings():  # that a length or the noise is at its bound
        warnings.simplefilter("ignore")
        return process.fit(places, values)
