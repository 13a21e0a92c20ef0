"""Searches to compare with: Adam by the published recipes of DIFFCLOUD and DiffCP, and CMA-ES.

None of them gives standard errors.
"""

import dataclasses
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import random
from jaxtyping import Array, Float, PRNGKeyArray

from r2s._util.extras import require
from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.gauss_newton import loss_at
from r2s.estimation.method import Progress
from r2s.estimation.normal_equations import Loss
from r2s.estimation.prediction import (
    Prediction,
    explain,
    free_nuisances,
    nuisances,
    theta_length,
)
from r2s.estimation.problem import Problem, Problems, check_shared
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range
from r2s.mesh.surface import sample
from r2s.metrics.losses import one_sided_chamfer, surface_residuals
from r2s.solvers.mpm.sheet import MPMCloth

EDGE = 1e-3  # of the unit cube: beyond it the sigmoid's slope is lost
EPOCHS = 51
STRETCH = Range("stretch multiplier", "-", 0.05, 10.0, log=False)
MASS = Range("mass multiplier", "-", 0.1, 10.0, log=False)
DIFFCLOUD_RATE, DIFFCP_RATE = 0.2, 0.05  # of Adam
RESOLUTION = 5  # squared, samples on a face: 3,200 of theirs 3,500 on 128 faces
PUBLISHED_START = {"E h": 100.0, "nu": 0.1}  # where the public code of DiffCP starts
DIVERGED = 1.0  # [m^2]: the loss of a run that diverged, above that of any that did not
WIDTH = 0.25  # of the unit cube: the first standard deviation of CMA-ES
FARTHEST = 4.0  # prior standard deviations, by which a nuisance parameter may be off
ARRIVED = ("tolx", "tolfun", "tolfunhist", "tolfunrel")  # criteria of cma that mean convergence


def adam(
    problem: Problem,
    loss: Loss,
    *,
    approach: str,
    epochs: int,
    rate: float,
    start: Float[Array, " dim"] | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """Descend by Adam on a loss [m^2] in the space's unit cube, through a sigmoid; the best epoch.

    - `epochs`, `rate`: Adam's. An epoch whose loss or gradient is not finite is the last.
    - `start`: in the unit cube; None: the middle of the range.

    Adam has no criterion to stop by: the estimate says `converged=False`. Raises `RuntimeError`
    when the loss of the first epoch is not finite.
    """
    began, space = time.perf_counter(), problem.space
    place = jnp.full(space.dim, 0.5, float) if start is None else jnp.clip(start, EDGE, 1 - EDGE)
    raw: Any = jnp.log(place) - jnp.log1p(-place)  # optax returns the type that it is given
    optimiser = optax.adam(rate)
    state = optimiser.init(raw)
    losses, places = [], []
    for epoch in range(epochs):
        value, slope = _loss_and_gradient(problem, raw, loss)
        losses.append(float(value))
        places.append(jax.nn.sigmoid(raw))
        if not (np.isfinite(losses[-1]) and np.all(np.isfinite(np.asarray(slope)))):
            break
        update, state = optimiser.update(slope, state)
        raw = optax.apply_updates(raw, update)
        if progress is not None:
            progress(epoch, min(losses))
    history = np.stack([np.asarray(space.values(place)) for place in places])
    if not np.isfinite(losses[0]):
        nothing = jnp.zeros(theta_length((problem,)) - space.dim, float)
        why = explain(problem, jnp.concatenate([places[0], nothing]))
        why = why or "has a loss that is not finite"
        raise RuntimeError(f"{approach}: the simulation of the start, {history[0]}, {why}")
    best = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
    return point_estimate(
        approach,
        space,
        places[best],
        losses[best],
        np.array(losses)[:, None],
        history[:, None],
        time.perf_counter() - began,
    )


@eqx.filter_jit
def _loss_and_gradient(problem: Problem, raw, loss: Loss):
    nothing = jnp.zeros(theta_length((problem,)) - raw.shape[0], raw.dtype)

    def value(raw):
        return loss_at((problem,), jnp.concatenate([jax.nn.sigmoid(raw), nothing]), loss)

    return jax.value_and_grad(value)(raw)


class MultiplierSpace(ParameterSpace):
    """Fabrics that are an assumed one but for two multipliers: of all membrane stiffness, and of
    the mass (in the DIFFCLOUD paper that of 20 listed vertices, here of all)."""

    assumed: Fabric
    ranges: tuple[Range, ...] = (STRETCH, MASS)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit square."""
        stretch, mass = self.values(u)
        law = self.assumed.membrane
        law = dataclasses.replace(
            law, **{name: getattr(law, name) * stretch for name in ("c11", "c12", "c22", "c33")}
        )
        return dataclasses.replace(self.assumed, density=self.assumed.density * mass, membrane=law)

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric with multiples of the assumed one's C11 and density lies."""
        stretch = STRETCH.to_unit(fabric.membrane.c11 / self.assumed.membrane.c11)
        return jnp.stack([stretch, MASS.to_unit(fabric.density / self.assumed.density)])


def last_frame(problem: Problem, seen: Prediction) -> Float[Array, ""]:
    """Mean squared distance [m^2] from samples of the simulated surface to the last cloud."""
    if problem.clouds is None:
        raise ValueError("the recipe of DIFFCLOUD compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces
    surface = sample(seen.x[-1], faces, RESOLUTION)
    points, mask = problem.clouds.points[-1], problem.clouds.mask[-1]
    targets = jnp.where(mask[:, None], points, jnp.inf)  # padding is never the nearest
    return one_sided_chamfer(surface, jnp.ones(surface.shape[0], bool), targets)


def diffcloud_recipe(
    problem: Problem, assumed: Fabric, epochs: int = EPOCHS, progress: Progress | None = None
) -> Estimate:
    """The recipe of the DIFFCLOUD paper: two multipliers of an `assumed` fabric, by Adam on
    `last_frame`, through a sigmoid from the middle of the range."""
    return adam(
        dataclasses.replace(problem, space=MultiplierSpace(assumed=assumed)),
        last_frame,
        approach="diffcloud-published (Adam 0.2, 51 epochs, 3,200 samples, last frame)",
        epochs=epochs,
        rate=DIFFCLOUD_RATE,
        progress=progress,
    )


def squared_third(problem: Problem, seen: Prediction) -> Float[Array, ""]:
    """A third of the mean squared distance [m^2] from the clouds to the surface: DiffCP's loss."""
    if problem.clouds is None:
        raise ValueError("the recipe of DiffCP compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces

    def frame(args):
        points, mask, x = args
        distance, *_ = surface_residuals(points, mask, x, faces)
        return jnp.sum(jnp.where(mask, distance**2, 0)), jnp.sum(mask, dtype=distance.dtype)

    total, count = jax.lax.map(frame, (problem.clouds.points, problem.clouds.mask, seen.x))
    return jnp.sum(total) / jnp.sum(count) / 3


def diffcp_recipe(
    problem: Problem, epochs: int = EPOCHS, progress: Progress | None = None
) -> Estimate:
    """The public settings of DiffCP: Adam on the exact gradient of `squared_third`, from
    `PUBLISHED_START`.

    Theirs takes single steps on short windows, whose length and rate are not published; this
    descends on all frames that count. Raises `ValueError` for a problem that is not on material
    points.
    """
    if not isinstance(problem.solver, MPMCloth):
        raise ValueError("DiffCP simulates material points: see `methods.problems_on_mpm`")
    start = [
        bound.to_unit(jnp.asarray(PUBLISHED_START[bound.name], float))
        if bound.name in PUBLISHED_START
        else jnp.asarray(0.5, float)
        for bound in problem.space.ranges
    ]
    return adam(
        problem,
        squared_third,
        approach=f"diffcp-published (Adam {DIFFCP_RATE:g}, {epochs} epochs)",
        start=jnp.stack(start),
        epochs=epochs,
        rate=DIFFCP_RATE,
        progress=progress,
    )


_losses = eqx.filter_jit(eqx.filter_vmap(loss_at, in_axes=(None, 0)))


def cma_es(
    problems: Problems,
    evaluations: int,
    *,
    start: Float[Array, " dim"] | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The best of some `evaluations` of the robust loss that CMA-ES (Hansen 2016) proposes.

    It starts in the middle of the range, or from `start`, moves the nuisance parameters along with
    the fabric, and has converged when its tolerances in place or loss say so.

    Raises `ValueError` for recordings whose shared nuisance parameters have unequal priors,
    `RuntimeError` where all runs diverged.
    """
    began = time.perf_counter()
    check_shared(problems)
    space, size = problems[0].space, theta_length(problems)
    moved = np.array(sorted(each.place for each in free_nuisances(problems)), int)
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
        thetas = np.zeros((len(asked), size))
        thetas[:, : space.dim] = asked[:, : space.dim]
        thetas[:, moved] = asked[:, space.dim :]
        found = np.asarray(_losses(problems, jnp.asarray(thetas, float)), float)
        penalized = _with_prior(problems, found, asked[:, space.dim :])
        strategy.tell(list(asked), penalized.tolist())
        lead = int(np.argmin(penalized))
        if penalized[lead] < best[0]:
            best = float(penalized[lead]), asked[lead], float(found[lead])
        losses.append(float(found[lead]))
        history.append(np.asarray(space.values(_unit(space.dim, best[1]))))
        if progress is not None:
            progress(len(losses), best[0])
    if not np.isfinite(best[2]):
        raise RuntimeError(
            f"all {strategy.countevals} simulations of CMA-ES diverged: check the recording's "
            "units and gripper path, or narrow the space's ranges"
        )
    theta, unknown = np.zeros(size), np.full(size, np.nan)
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
    return dataclasses.replace(found, nuisances=nuisances(problems, theta, unknown))


def _unit(dim: int, proposal: np.ndarray) -> Array:
    """The place of a proposal in the space's unit cube."""
    return jnp.asarray(np.clip(proposal[:dim], 0, 1), float)


def _with_prior(problems: Problems, losses: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """Losses [m^2] with the prior of the nuisance parameters."""
    least = np.min(losses, where=np.isfinite(losses), initial=DIVERGED)
    frames = sum(len(problem.frames) for problem in problems)
    penalty = 2 * least / frames * np.sum(nuisances**2, axis=1) / 2
    return np.where(np.isfinite(losses), losses + penalty, DIVERGED)
