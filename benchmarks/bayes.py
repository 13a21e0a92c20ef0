"""The Bayesian search of PhysNet's published recipe beside scikit-optimize's `Optimizer`.

    python benchmarks/bayes.py

Prints, for three losses in seven dimensions, the median over seeds of the least loss, the seeds in
which scikit-optimize's is lower, and the CPU time of a search. It takes five CPU minutes.
"""

import argparse
import time
import warnings
from functools import partial

import numpy as np
from skopt import Optimizer

from r2s.estimation.physnet import bayes

CENTRE = np.array([0.2, 0.7, 0.45, 0.6, 0.3, 0.8, 0.5])
GENERATOR = np.random.default_rng(7)
WAVES, PHASES = GENERATOR.normal(size=(7, 16)), GENERATOR.uniform(0, 6, 16)
AXES = np.linalg.qr(np.random.default_rng(3).normal(size=(7, 7)))[0]


def bowl(places):
    """A distance from the centre to which two of the coordinates contribute little."""
    weights = np.array([1, 1, 1, 0.1, 1, 0.1, 1])
    return np.sqrt((weights * (places - CENTRE) ** 2).sum(axis=1) + 1e-3)


def waves(places):
    """The rms difference of sixteen smooth answers from those of the centre."""
    return np.sqrt(((_answers(places) - _answers(CENTRE[None])) ** 2).mean(axis=1))


def _answers(places):
    return np.sin(1.5 * places @ WAVES + PHASES) + 0.3 * np.cos(places @ WAVES[:, ::-1])


def ridge(places):
    """A distance along turned axes of very different weights, rough by 5 %."""
    weights = np.array([3, 2, 1, 1, 0.3, 0.1, 0.05])
    smooth = np.sqrt((weights * ((places - CENTRE) @ AXES) ** 2).sum(axis=1) + 1e-3)
    noise = np.modf(np.abs(np.sin(places @ (1e4 * np.arange(1, 8)))) * 1e4)[0]
    return smooth * (0.95 + 0.1 * noise)


def ask_library(history, number, *, num_first, seed, acquisition="EI"):
    """`bayes.ask` by an `Optimizer` that is told the whole history."""
    done, dim = history.places.shape
    if done < num_first:
        return bayes.ask(history, number, num_first=num_first, seed=seed)
    optimizer = Optimizer(
        [(0.0, 1.0)] * dim,
        n_initial_points=0,
        acq_func=acquisition,
        acq_func_kwargs={"xi": 0.0},
        random_state=np.random.RandomState([seed, done]),
    )
    optimizer.tell(history.places.tolist(), np.log(history.penalised).tolist(), fit=False)
    return np.array(optimizer.ask(number))


def search(objective, ask, seed: int, calls: int) -> tuple[float, float]:
    """The least loss of a search, and its CPU time [s]."""
    began, history = time.process_time(), bayes.begin(7)
    while len(history.losses) < calls:
        places = ask(history, min(4, calls - len(history.losses)), num_first=16, seed=seed)
        history = bayes.tell(history, places, objective(places))
    return history.losses.min(), time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=5)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")  # that a place was tried before
    asks = {"r2s": bayes.ask, "skopt EI": ask_library}
    asks["skopt gp_hedge"] = partial(ask_library, acquisition="gp_hedge")
    for objective in (bowl, waves, ridge):
        ours = None
        for name, ask in asks.items():
            runs = [search(objective, ask, seed, asked.calls) for seed in range(asked.seeds)]
            losses, seconds = np.array(runs).T
            ours = losses if ours is None else ours
            print(
                f"{objective.__name__}, {name}: {np.median(losses):.4f}, lower in "
                f"{(losses < ours).sum()} of {asked.seeds}, {np.median(seconds):.1f} CPU s",
                flush=True,
            )


if __name__ == "__main__":
    main()
