"""CMA-ES: the evolutionary baseline, which needs no derivative.

Needs cma: pip install 'r2s[cma]'.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.descent import Progress
from r2s.estimation.estimate import Estimate, without_standard_errors
from r2s.estimation.gauss_newton import Joint, loss_at, part_of, size
from r2s.estimation.normal_equations import Loss
from r2s.estimation.problem import Problem

DIVERGED = 1.0  # [m^2]: the loss of a run that diverged, above that of any that did not
WIDTH = 0.25  # of the unit cube, the first deviation

_losses = eqx.filter_jit(eqx.filter_vmap(loss_at, in_axes=(None, 0, None)))


def estimate(
    problems: Problem | Joint,
    *,
    evaluations: int = 600,
    start: Float[Array, " dim"] | None = None,
    loss: Loss | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The best of some `evaluations` of the loss that CMA-ES (Hansen 2016) proposes from `start`.

    It moves the cameras along with the fabric where they are in nuisance_prior, as the default
    estimator does. Ends earlier when its own criteria say so. Gives no deviations.
    """
    try:
        import cma
    except ImportError as error:
        raise ImportError("CMA-ES needs cma: pip install 'r2s[cma]'") from error
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    space, count = problems[0].space, size(problems)
    place = np.full(space.dim, 0.5) if start is None else np.asarray(start, float)
    moved = _moved(problems)
    bounds = [[0.0] * space.dim + [-4.0] * len(moved), [1.0] * space.dim + [4.0] * len(moved)]
    options = {
        "bounds": bounds,
        "seed": int(jax.random.randint(key, (), 1, 2**31 - 1)),
        "maxfevals": evaluations,
        "verbose": -9,
        "CMA_stds": [1.0] * space.dim + [2.0] * len(moved),
    }
    first = np.concatenate([np.clip(place, 0, 1), np.zeros(len(moved))])
    search = cma.CMAEvolutionStrategy(first, WIDTH, options)
    losses, history, best = [], [], (np.inf, first)
    while not search.stop():
        asked = np.array(search.ask())
        unknowns = np.zeros((len(asked), count))
        unknowns[:, : space.dim] = asked[:, : space.dim]
        unknowns[:, moved] = asked[:, space.dim :]
        found = np.asarray(_losses(problems, jnp.asarray(unknowns, float), loss), float)
        # the prior of what is in nuisance_prior, so that it does not run away
        pull = np.sum(asked[:, space.dim :] ** 2, axis=1) / 2
        spread = np.nanmin(np.where(np.isfinite(found), found, np.nan))
        frames = sum(len(problem.frames) for problem in problems)
        told = np.where(np.isfinite(found), found + 2 * spread / frames * pull, DIVERGED)
        search.tell(list(asked), told.tolist())
        lead = int(np.argmin(told))
        if told[lead] < best[0]:
            best = float(told[lead]), asked[lead]
        losses.append(float(found[lead]))
        history.append(_values(space, best[1]))
        if progress is not None:
            progress(len(losses), best[0])
    where = jnp.asarray(np.clip(best[1][: space.dim], 0, 1), float)
    seconds = time.perf_counter() - began
    columns = np.array(losses)[:, None], np.stack(history)[:, None]
    return without_standard_errors("cma_es", space, where, min(losses), *columns, seconds)


def _values(space, place: np.ndarray) -> np.ndarray:
    return np.asarray(space.values(jnp.asarray(np.clip(place[: space.dim], 0, 1), float)))


def _moved(problems: Joint) -> np.ndarray:
    """Which entries of the unknown beyond the fabric's place are in doubt."""
    dim, found = problems[0].space.dim, []
    for which, problem in enumerate(problems):
        places = part_of(problems, which)[dim:]
        found += [
            place
            for place, scale in zip(places, problem.nuisance_prior.scales, strict=True)
            if scale
        ]
    return np.unique(np.array(found, int))
