"""DIFFCLOUD and DiffCP; to compare with, their published recipes and CMA-ES; and all `METHODS`.

- DIFFCLOUD: Sundaresan, Antonova and Bohg 2022 ("DiffCloud: Real-to-Sim from Point Clouds with
  Differentiable Simulation and Rendering of Deformable Objects").
- DiffCP: Zheng et al. 2024 ("Differentiable cloth parameter identification and state estimation in
  manipulation").

The methods of this module to compare with give no standard errors.
"""

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import random
from jaxtyping import Array, Float, PRNGKeyArray

from r2s._util.extras import require
from r2s.estimation.descent import DEFAULT, Run
from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.gauss_newton import loss_at
from r2s.estimation.mesh_refinement import descend_by_meshes, descend_on_mpm
from r2s.estimation.method import ANY, Budget, DataRequirements, Method, Progress, frames_that_count
from r2s.estimation.normal_equations import Loss
from r2s.estimation.physnet.method import PhysNetMethod, PublishedPhysNet
from r2s.estimation.pinn.method import PINN, PublishedPINN
from r2s.estimation.prediction import (
    Prediction,
    explain,
    free_nuisances,
    nuisances,
    remembering,
    theta_length,
)
from r2s.estimation.problem import (
    POINTS,
    Problem,
    Problems,
    check_shared,
    problems_on_mpm,
    read_by_problem,
)
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range
from r2s.mesh.surface import sample
from r2s.metrics.losses import one_sided_chamfer, surface_residuals
from r2s.scenarios.scenario import from_recording

WIDTH = 0.02  # of the range: the slope of exact material points is rough below that
SEARCHED = ("num_samples", "num_starts", "max_iterations")
EDGE = 1e-3  # of the unit cube: beyond it the sigmoid's slope is lost
EPOCHS = 51
STRETCH = Range("stretch multiplier", "-", 0.05, 10.0, log=False)
MASS = Range("mass multiplier", "-", 0.1, 10.0, log=False)
DIFFCLOUD_RATE, DIFFCP_RATE = 0.2, 0.05  # of Adam
RESOLUTION = 5  # squared, samples on a face: 3,200 of theirs 3,500 on 128 faces
PUBLISHED_START = {"E h": 100.0, "nu": 0.1}  # where the public code of DiffCP starts
DIVERGED = 1.0  # [m^2]: the loss of a run that diverged, above that of any that did not
SPREAD = 0.25  # of the unit cube: the first standard deviation of CMA-ES
FARTHEST = 4.0  # prior standard deviations, by which a nuisance parameter may be off
ARRIVED = ("tolx", "tolfun", "tolfunhist", "tolfunrel")  # criteria of cma that mean convergence
NO_POINTS = {"mpm": "it differentiates through the cloth; on material points take diffcp"}
NO_CLOTH = {"cloth": "it differentiates through material points; on the cloth take diffcloud"}


@dataclass(frozen=True, kw_only=True)
class DiffCloud(Method):
    """The method of DIFFCLOUD: Gauss-Newton descents through the cloth.

    - `finest`: continues on the finest mesh, whichever fabric is found on the coarser: minutes
      instead of one, and right where the fabric's folds decide (docs/guide/estimate.md).
    """

    name = "diffcloud"
    budget = DEFAULT._replace(num_samples=0, num_starts=1)
    budget_fields = SEARCHED
    supports = {"cloth": ANY}
    refusals = NO_POINTS
    several = True
    takes_prior = True

    finest: bool = False

    def reads(self, recording):
        return read_by_problem(recording)

    def _estimate(self, recordings, space, budget, key):
        if self.finest and self.shape:
            raise ValueError("a shape is that of the whole estimate: leave it out for the finest")
        run = Run(budget, key, remembering(), self.checkpoint, self.progress)
        return descend_by_meshes(recordings, space, run, self.shape, self.finest)


@dataclass(frozen=True, kw_only=True)
class DiffCP(Method):
    """The method of DiffCP: Gauss-Newton descents through material points, with slopes over a width
    of the range."""

    name = "diffcp"
    budget = Budget(num_samples=12, num_starts=2, secant_width=WIDTH, num_probes=4)
    budget_fields = SEARCHED
    supports = {"mpm": ANY}
    refusals = NO_CLOTH
    several = True
    takes_prior = True

    def reads(self, recording):
        return read_by_problem(recording)

    def _estimate(self, recordings, space, budget, key):
        run = Run(budget, key, remembering(), self.checkpoint, self.progress)
        return descend_on_mpm(recordings, space, run, self.chosen_shape)


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
        why = explain(problem, _with_nuisances(problem, places[0]))
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


def _with_nuisances(problem: Problem, place: Array) -> Array:
    """Theta at a place, with all nuisance parameters zero."""
    zeros = jnp.zeros(theta_length((problem,)) - place.shape[0], place.dtype)
    return jnp.concatenate([place, zeros])


@eqx.filter_jit
def _loss_and_gradient(problem: Problem, raw, loss: Loss):
    def value(raw):
        return loss_at((problem,), _with_nuisances(problem, jax.nn.sigmoid(raw)), loss)

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
        assumed = self.assumed
        return self.places(
            fabric.membrane.c11 / assumed.membrane.c11, fabric.density / assumed.density
        )


def last_frame(problem: Problem, prediction: Prediction) -> Float[Array, ""]:
    """Mean squared distance [m^2] from samples of the simulated surface to the last cloud."""
    if problem.clouds is None:
        raise ValueError("the recipe of DIFFCLOUD compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces
    surface = sample(prediction.x[-1], faces, RESOLUTION)
    points, mask = problem.clouds.points[-1], problem.clouds.mask[-1]
    targets = jnp.where(mask[:, None], points, jnp.inf)  # padding is never the nearest
    return one_sided_chamfer(surface, jnp.ones(surface.shape[0], bool), targets)


def squared_third(problem: Problem, prediction: Prediction) -> Float[Array, ""]:
    """A third of the mean squared distance [m^2] from the clouds to the surface: DiffCP's loss."""
    if problem.clouds is None:
        raise ValueError("the recipe of DiffCP compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces

    def frame(args):
        points, mask, x = args
        distance, *_ = surface_residuals(points, mask, x, faces)
        return jnp.sum(jnp.where(mask, distance**2, 0)), jnp.sum(mask, dtype=distance.dtype)

    total, count = jax.lax.map(frame, (problem.clouds.points, problem.clouds.mask, prediction.x))
    return jnp.sum(total) / jnp.sum(count) / 3


@dataclass(frozen=True, kw_only=True)
class PublishedDiffCloud(Method):
    """The recipe of the DIFFCLOUD paper: two multipliers of an assumed fabric, by Adam on
    `last_frame`, through a sigmoid from the middle of the range.

    - `assumed`: the fabric whose stiffness and mass are multiplied; None: the middle of the space.
    """

    name = "diffcloud-published"
    budget = Budget(max_iterations=EPOCHS)
    budget_fields = ("max_iterations",)
    supports = {"cloth": ANY}
    refusals = NO_POINTS

    assumed: Fabric | None = None

    def reads(self, recording):
        first, *_, last = (0, *frames_that_count(recording))
        hangs = from_recording(recording, self.chosen_shape).brake is not None
        is_shown = hangs and recording.info.frames_used[0] == 0  # how it hangs at first
        return DataRequirements((first, last) if is_shown else (last,), points=POINTS)

    def _estimate(self, recordings, space, budget, key):
        del key  # it starts in the middle
        problem = Problem.make(recordings[0], space, shape=self.chosen_shape)
        multiplied = MultiplierSpace(assumed=self.assumed or space.middle())
        estimate = adam(
            dataclasses.replace(problem, space=multiplied),
            last_frame,
            approach="diffcloud-published (Adam 0.2, 51 epochs, 3,200 samples, last frame)",
            epochs=budget.max_iterations,
            rate=DIFFCLOUD_RATE,
            progress=self.progress,
        )
        return dataclasses.replace(estimate, shape=self.chosen_shape)


@dataclass(frozen=True, kw_only=True)
class PublishedDiffCP(Method):
    """The public settings of DiffCP: Adam on the exact gradient of `squared_third`, from
    `PUBLISHED_START`.

    Theirs takes single steps on short windows, whose length and rate are not published; this
    descends on all frames that count.
    """

    name = "diffcp-published"
    budget = Budget(max_iterations=EPOCHS)
    budget_fields = ("max_iterations",)
    supports = {"mpm": ANY}
    refusals = NO_CLOTH

    def reads(self, recording):
        return DataRequirements(frames_that_count(recording), points=POINTS)

    def _estimate(self, recordings, space, budget, key):
        del key  # it starts where the public code does
        (problem,) = problems_on_mpm(recordings, space, self.chosen_shape)
        start = [
            bound.to_unit(jnp.asarray(PUBLISHED_START[bound.name], float))
            if bound.name in PUBLISHED_START
            else jnp.asarray(0.5, float)
            for bound in space.ranges
        ]
        estimate = adam(
            problem,
            squared_third,
            approach=f"diffcp-published (Adam {DIFFCP_RATE:g}, {budget.max_iterations} epochs)",
            start=jnp.stack(start),
            epochs=budget.max_iterations,
            rate=DIFFCP_RATE,
            progress=self.progress,
        )
        return dataclasses.replace(estimate, shape=self.chosen_shape)


@dataclass(frozen=True, kw_only=True)
class CMAES(Method):
    """CMA-ES on the loss of the default methods. Needs cma: pip install 'r2s[cma]'."""

    name = "cma-es"
    budget = Budget(max_evaluations=600)
    budget_fields = ("max_evaluations",)
    supports = {"cloth": ANY, "mpm": ANY}
    several = True

    def reads(self, recording):
        return read_by_problem(recording)

    def _estimate(self, recordings, space, budget, key):
        require("cma", "cma", "CMA-ES")  # before anything is simulated
        shape = self.chosen_shape
        if self.chosen_solver == "mpm":
            problems = problems_on_mpm(recordings, space, shape)
        else:
            problems = tuple(Problem.make(each, space, shape=shape) for each in recordings)
        estimate = cma_es(problems, budget.max_evaluations, progress=self.progress, key=key)
        return dataclasses.replace(estimate, shape=shape)


_losses = eqx.filter_jit(eqx.filter_vmap(loss_at, in_axes=(None, 0)))


def cma_es(
    problems: Problems, evaluations: int, *, progress: Progress | None = None, key: PRNGKeyArray
) -> Estimate:
    """The best of some `evaluations` of the robust loss that CMA-ES (Hansen 2016) proposes.

    It starts in the middle of the range, moves the nuisance parameters along with the fabric, and
    has converged when its tolerances in place or loss say so.

    Raises `ValueError` for recordings whose shared nuisance parameters have unequal priors,
    `RuntimeError` where all runs diverged.
    """
    began = time.perf_counter()
    check_shared(problems)
    space, size = problems[0].space, theta_length(problems)
    moved = np.array(sorted(nuisance.place for nuisance in free_nuisances(problems)), int)
    first = np.r_[np.full(space.dim, 0.5), np.zeros(len(moved))]
    low = [0.0] * space.dim + [-FARTHEST] * len(moved)
    high = [1.0] * space.dim + [FARTHEST] * len(moved)
    generator = np.random.default_rng(int(random.randint(key, (), 1, 2**31 - 1)))
    options = {
        "bounds": [low, high],
        "seed": np.nan,  # else cma seeds the generator that all share
        "randn": lambda *shape: generator.standard_normal(shape),
        "maxfevals": evaluations,
        "verbose": -9,
        "CMA_stds": [1.0] * space.dim + [2.0] * len(moved),
    }
    strategy = require("cma", "cma", "CMA-ES").CMAEvolutionStrategy(first, SPREAD, options)
    losses, places, best = [], [], (np.inf, first, np.inf)
    while not strategy.stop():
        asked = np.array(strategy.ask())
        thetas = np.zeros((len(asked), size))
        thetas[:, : space.dim] = asked[:, : space.dim]
        thetas[:, moved] = asked[:, space.dim :]
        loss = np.asarray(_losses(problems, jnp.asarray(thetas, float)), float)
        penalized = _with_prior(problems, loss, asked[:, space.dim :])
        strategy.tell(list(asked), penalized.tolist())
        lead = int(np.argmin(penalized))
        if penalized[lead] < best[0]:
            best = float(penalized[lead]), asked[lead], float(loss[lead])
        losses.append(float(loss[lead]))
        places.append(jnp.asarray(np.clip(best[1][: space.dim], 0, 1), float))
        if progress is not None:
            progress(len(losses), best[0])
    if not np.isfinite(best[2]):
        raise RuntimeError(
            f"all {strategy.countevals} simulations of CMA-ES diverged: check the recording's "
            "units and gripper path, or narrow the space's ranges"
        )
    theta, unknown = np.zeros(size), np.full(size, np.nan)
    theta[moved] = best[1][space.dim :]
    estimate = point_estimate(
        "cma-es",
        space,
        places[-1],
        best[2],
        np.array(losses)[:, None],
        np.stack([np.asarray(space.values(place)) for place in places])[:, None],
        time.perf_counter() - began,
        converged=any(name in strategy.stop() for name in ARRIVED),
    )
    return dataclasses.replace(estimate, nuisances=nuisances(problems, theta, unknown))


def _with_prior(problems: Problems, losses: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """Losses [m^2] with the prior of the nuisance parameters."""
    least = np.min(losses, where=np.isfinite(losses), initial=DIVERGED)
    frames = sum(len(problem.frames) for problem in problems)
    penalty = 2 * least / frames * np.sum(nuisances**2, axis=1) / 2
    return np.where(np.isfinite(losses), losses + penalty, DIVERGED)


class _Methods(dict[str, type[Method]]):
    def __missing__(self, name: str) -> type[Method]:
        raise KeyError(f"no method {name!r}; there are {', '.join(self)}")


METHODS = _Methods(
    (method.name, method)
    for method in (
        DiffCloud,
        DiffCP,
        PhysNetMethod,
        PINN,
        CMAES,
        PublishedDiffCloud,
        PublishedDiffCP,
        PublishedPhysNet,
        PublishedPINN,
    )
)
"""All methods by name, for the command line and the study; a `KeyError` names them."""
