"""Places of a search by an emulator of the answers.

A Gaussian process emulates each principal component of the answers, because 80 answers of many
numbers say more of where the target lies than 80 losses (composite Bayesian optimisation, Astudillo
and Frazier 2019). It is our own beside scikit-optimize, which models a scalar loss alone: its
estimates of shear, friction and coupling are 0.05, 0.05 and 0.30 of the range off (80 simulations),
where Bayesian optimisation of the loss had 0.25, 0.10 and 0.60 (44 simulations; version 0.2.0).
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from r2s._util.extras import require
from r2s.estimation.physnet.search import Places, Respond, Trials, minimise

COMPONENTS = 10  # principal components of the answers, at most
FIRST = 0.4  # share of the calls that fill the cube evenly
CANDIDATES = 1000  # random places anywhere, and as many around the best
CENTRES = 5  # number of the best places
WIDTHS = (0.01, 0.5)  # of the Gaussians around them, evenly on a logarithmic scale


def search(
    respond: Respond,
    target: Float[np.ndarray, " part"],
    dim: int,
    *,
    num_calls: int = 80,
    shared: int = 1,
    **options: Any,
) -> Trials:
    """Trials, of which the last is where the target most likely lies.

    - `shared`: number of parts of an answer, such as frames, that share one error of the target.
    - `options`: of `r2s.estimation.physnet.search.minimise`.

    The share `FIRST` of the calls fills the cube. Raises `ValueError` for fewer than `dim` + 2
    calls, and as `minimise` does.
    """
    if num_calls < dim + 2:
        raise ValueError(f"expected at least {dim + 2} calls in {dim} dimensions, got {num_calls}")
    first = max(int(FIRST * num_calls), dim + 1)
    how = partial(ask, shared=shared)
    return minimise(respond, target, how, dim, num_calls=num_calls, num_first=first, **options)


def ask(
    trials: Trials, batch: int, left: int, generator: np.random.Generator, *, shared: int = 1
) -> Places:
    """The next places, drawn by the likelihood of the target; for the last call the most likely.

    The likelihood is from the emulator's deviation and the error of the target, which the least
    loss estimates. For the arguments see `search` and `r2s.estimation.physnet.search.minimise`.
    """
    known = trials.successful
    best = known.places[np.argsort(known.losses)[:CENTRES]]
    number = min(batch, left - 1)
    tried = np.concatenate([candidates(best, generator) for _ in range(1 if number else 4)])
    misfit = _misfit(known, shared * known.losses.min() ** 2)(tried)
    if not number:
        return tried[np.argmin(misfit)][None]
    chance = np.exp(-(misfit - misfit.min()) / 2)
    chance = chance + 1e-12  # so that there are enough to draw
    return tried[generator.choice(len(tried), number, replace=False, p=chance / chance.sum())]


def candidates(
    best: Float[np.ndarray, "centre dim"], generator: np.random.Generator
) -> Float[np.ndarray, "place dim"]:
    """Random places of the unit cube, half of them anywhere and half around the best so far."""
    dim = best.shape[1]
    anywhere = generator.random((CANDIDATES, dim))
    low, high = np.log(WIDTHS)
    widths = np.exp(generator.uniform(low, high, (CANDIDATES, 1)))
    centres = best[generator.integers(len(best), size=CANDIDATES)]
    around = centres + widths * generator.standard_normal((CANDIDATES, dim))
    return np.concatenate([anywhere, np.clip(around, 0, 1)])


def _misfit(trials: Trials, variance: float) -> Callable[[np.ndarray], np.ndarray]:
    """Minus twice the log-likelihood of the target at places, by an emulator of the residuals."""
    mean = trials.residuals.mean(axis=0)
    _, _, axes = np.linalg.svd(trials.residuals - mean, full_matrices=False)
    axes = axes[:COMPONENTS]
    wanted = -axes @ mean
    components = axes @ (trials.residuals - mean).T
    processes = [_process(trials.places, component) for component in components]

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
