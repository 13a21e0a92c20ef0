"""CMA-ES: the evolutionary baseline, which needs no derivative.

Needs cma: pip install 'r2s[cma]'.
"""

import time
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float, PRNGKeyArray

from r2s._util.extras import require
from r2s.estimation.diffcp import problems_on_points
from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.gauss_newton import Problems, loss_at, theta_length
from r2s.estimation.method import ANY, Budget, Method, Progress
from r2s.estimation.normal_equations import Loss
from r2s.estimation.nuisances import free, nuisances
from r2s.estimation.problem import Problem, check_shared, read_by_problem

DIVERGED = 1.0  # [m^2]: the loss of a run that diverged, above that of any that did not
WIDTH = 0.25  # of the unit cube: the first standard deviation
FARTHEST = 4.0  # prior standard deviations, by which a nuisance may be off
EVALUATIONS = 600
ARRIVED = ("tolx", "tolfun", "tolfunhist", "tolfunrel")  # its criteria that mean convergence

_losses = eqx.filter_jit(eqx.filter_vmap(loss_at, in_axes=(None, 0, None)))


@dataclass(frozen=True, kw_only=True)
class CMAES(Method):
    """CMA-ES on the loss of the default methods."""

    name = "cma-es"
    budget = Budget(evaluations=EVALUATIONS)
    heeds = ("evaluations",)
    supports = {"cloth": ANY, "points": ANY}
    several = True

    def reads(self, recording):
        return read_by_problem(recording)

    def _estimate(self, recordings, space, budget, key):
        require("cma", "cma", "CMA-ES")  # before anything is simulated
        if self.chosen_solver == "points":
            problems = problems_on_points(recordings, space, self.chosen_shape)
        else:
            shape = self.chosen_shape
            problems = tuple(Problem.make(each, space, shape=shape) for each in recordings)
        found = search(problems, evaluations=budget.evaluations, progress=self.progress, key=key)
        return replace(found, shape=self.chosen_shape)


def search(
    problems: Problem | Problems,
    *,
    evaluations: int = EVALUATIONS,
    start: Float[Array, " dim"] | None = None,
    loss: Loss | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The best of some `evaluations` of the loss that CMA-ES (Hansen 2016) proposes from `start`.

    It moves the nuisances of the prior along with the fabric, as the default methods do, and tells
    them. It ends earlier, and has converged, when its tolerances in place or loss say so. Gives no
    standard errors.

    Raises `ValueError` for recordings whose shared nuisances are in doubt by different amounts,
    `RuntimeError` where all runs diverged.
    """
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    check_shared(problems)
    space = problems[0].space
    moved = np.array(sorted(each.place for each in free(problems)), int)
    place = np.full(space.dim, 0.5) if start is None else np.asarray(start, float)
    first = np.concatenate([np.clip(place, 0, 1), np.zeros(len(moved))])
    options = {
        "bounds": [
            [0.0] * space.dim + [-FARTHEST] * len(moved),
            [1.0] * space.dim + [FARTHEST] * len(moved),
        ],
        "seed": int(random.randint(key, (), 1, 2**31 - 1)),
        "maxfevals": evaluations,
        "verbose": -9,
        "CMA_stds": [1.0] * space.dim + [2.0] * len(moved),
    }
    strategy = require("cma", "cma", "CMA-ES").CMAEvolutionStrategy(first, WIDTH, options)
    losses, history, best = [], [], (np.inf, first, np.inf)
    while not strategy.stop():
        asked = np.array(strategy.ask())
        thetas = np.zeros((len(asked), theta_length(problems)))
        thetas[:, : space.dim] = asked[:, : space.dim]
        thetas[:, moved] = asked[:, space.dim :]
        found = np.asarray(_losses(problems, jnp.asarray(thetas, float), loss), float)
        told = _with_prior(problems, found, asked[:, space.dim :])
        strategy.tell(list(asked), told.tolist())
        lead = int(np.argmin(told))
        if told[lead] < best[0]:
            best = float(told[lead]), asked[lead], float(found[lead])
        losses.append(float(found[lead]))
        history.append(np.asarray(space.values(_unit(space.dim, best[1]))))
        if progress is not None:
            progress(len(losses), best[0])
    if not np.isfinite(best[2]):
        raise RuntimeError(
            f"all {strategy.countevals} simulations of CMA-ES diverged: check the recording's "
            "units and gripper path, or narrow the space's ranges"
        )
    theta, unknown = np.zeros(theta_length(problems)), np.full(theta_length(problems), np.nan)
    theta[moved] = best[1][space.dim :]
    found = point_estimate(
        "cma-es",
        space,
        _unit(space.dim, best[1]),
        best[2],
        np.array(losses)[:, None],
        np.stack(history)[:, None],
        time.perf_counter() - began,
        converged=any(name in strategy.stop() for name in ARRIVED),
    )
    return replace(found, nuisances=nuisances(problems, theta, unknown))


def _unit(dim: int, proposal: np.ndarray) -> Array:
    """The place of a proposal in the space's unit cube."""
    return jnp.asarray(np.clip(proposal[:dim], 0, 1), float)


def _with_prior(problems: Problems, losses: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """Losses [m^2] with the prior of the nuisances, so that these do not run away."""
    least = np.min(losses, where=np.isfinite(losses), initial=DIVERGED)
    frames = sum(len(problem.frames) for problem in problems)
    penalty = 2 * least / frames * np.sum(nuisances**2, axis=1) / 2
    return np.where(np.isfinite(losses), losses + penalty, DIVERGED)
