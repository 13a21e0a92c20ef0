"""Bayesian optimisation of answers that are vectors, towards a target.

A Gaussian process emulates each principal part of the answers, not the loss: 80 answers of some
numbers each say more of where the target lies than 80 losses (composite Bayesian optimisation,
Astudillo and Frazier 2019). It knows nothing of fabrics.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.estimation import checkpoint
from r2s.estimation.physnet.bayes import CENTRES, candidates, even

PARTS = 10  # of the answers, of the greatest variance, at most
FIRST = 0.4  # of the calls, that fill the cube evenly
Respond = Callable[[Float[np.ndarray, "place dim"]], Float[np.ndarray, "place part"]]


class Trials(NamedTuple):
    """What was tried, in order: places in the unit cube, and answers; NaN where one failed."""

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
    progress: Callable[[Trials], None] | None = None,
) -> Trials:
    """Trials, of which the last is where the target most likely lies.

    The first `FIRST` of the calls fill the cube; then each batch is drawn by how likely the target
    is there, by the emulator and the error of the target. That is estimated from the least loss,
    and counts as shared by so many parts (`shared`), such as those of all frames. The same seed
    gives the same trials; saved to `path` after every batch, they go on from there. Raises
    `ValueError` when that is of another search or for fewer than `dim` + 2 calls, and
    `RuntimeError` when all calls fail.
    """
    if num_calls < dim + 2:
        raise ValueError(f"expected at least {dim + 2} calls in {dim} dimensions, got {num_calls}")
    run = {"kind": "emulated search", "dim": dim, "calls": num_calls, "batch": batch, "seed": seed}
    trials = Trials(np.zeros((0, dim)), np.zeros((0, len(target))))
    if path is not None and (stored := checkpoint.load(path, run)) is not None:
        trials = Trials(**stored)
    first = even(dim, max(int(FIRST * num_calls), dim + 1), seed)
    while (done := len(trials.places)) < num_calls:
        if done < len(first):
            places = first[done : min(done + batch, num_calls)]
        else:
            number = min(batch, num_calls - 1 - done)
            places = _asked(trials, target, shared, number, np.random.default_rng([seed, done]))
        answers = respond(places)
        told = np.concatenate([trials.answers, answers])
        trials = Trials(np.concatenate([trials.places, places]), told)
        if path is not None:
            checkpoint.save(path, trials._asdict(), run)
        if progress is not None:
            progress(trials)
    return trials


def _asked(trials: Trials, target, shared: int, number: int, generator) -> np.ndarray:
    """Places drawn by their likelihood; for the last of all calls (0) the likeliest."""
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
    """How unlikely the target is at places: -2 log of its likelihood, by a fitted emulator."""
    middle = answers.mean(axis=0)
    _, _, axes = np.linalg.svd(answers - middle, full_matrices=False)
    axes = axes[: min(PARTS, len(axes))]
    wanted = (target - middle) @ axes.T
    processes = [_process(places, part) for part in ((answers - middle) @ axes.T).T]

    def misfit(tried: np.ndarray) -> np.ndarray:
        total = np.zeros(len(tried))
        for process, value in zip(processes, wanted, strict=True):
            mean, deviation = process.predict(tried, return_std=True)
            spread = deviation**2 + variance
            total += (mean - value) ** 2 / spread + np.log(spread)
        return total

    return misfit


def _process(places: np.ndarray, values: np.ndarray) -> Any:
    """A Gaussian process of one part, fitted."""
    try:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    except ImportError as error:
        raise ImportError("the search needs scikit-learn: pip install 'r2s[physnet]'") from error
    smooth = ConstantKernel(1.0, (0.1, 100.0)) * RBF([1.0] * places.shape[1], (0.2, 20.0))
    process = GaussianProcessRegressor(smooth + WhiteKernel(1e-2, (1e-4, 1.0)), normalize_y=True)
    with warnings.catch_warnings():  # that a length or the noise is at its bound
        warnings.simplefilter("ignore")
        return process.fit(places, values)
