"""Bayesian optimisation of the loss of a search, as in the published recipe, by scikit-optimize."""

import warnings

import numpy as np

from r2s._util.extras import require
from r2s.estimation.physnet.search import Places, Trials


def ask(trials: Trials, batch: int, left: int, generator: np.random.Generator) -> Places:
    """The next places: those of the greatest expected improvement of a Gaussian process.

    See `r2s.estimation.physnet.search.minimise` for the arguments. The process is one of the
    logarithm of the losses. A call that failed counts as the worst that did not: a fixed penalty
    far above the losses would dominate the process. The `Optimizer` is made anew for every batch,
    so that a search continues from a file as if it had not been interrupted.
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
        return np.array(optimizer.ask(min(batch, left)))
