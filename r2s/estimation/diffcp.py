"""DiffCP: a fabric from point clouds, by differentiating through material points.

After Zheng et al. 2024 ("Differentiable cloth parameter identification and state estimation in
manipulation"), whom the study follows. `DiffCP` is r2s's method, by Gauss-Newton with slopes over a
width of the range; `PublishedDiffCP` has the public settings.
"""

import dataclasses
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimation import adam
from r2s.estimation.estimate import Estimate
from r2s.estimation.mesh_ladder import descend_weighed
from r2s.estimation.method import ANY, Budget, Method, Progress, Reads, frames_that_count
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import POINTS, Problem, read_by_problem
from r2s.materials.parameters import ParameterSpace
from r2s.metrics.losses import surface_residuals
from r2s.recordings.recording import Recording
from r2s.scenarios.solvers import MEMBRANE_DAMPING, material_points
from r2s.solvers.mpm.sheet import Sheet

WIDTH = 0.02  # of the range: the slope of the exact motion is rough below that
PUBLISHED_START = {"E h": 100.0, "nu": 0.1}  # where the public code starts
EPOCHS, RATE = 51, 0.05
DEFAULT = Budget(coarse=12, starts=2, width=WIDTH, around=4)
REFUSALS = {"cloth": "it differentiates through material points; on the cloth take diffcloud"}


@dataclass(frozen=True, kw_only=True)
class DiffCP(Method):
    """The method of DiffCP: Gauss-Newton descents through material points."""

    name = "diffcp"
    budget = DEFAULT
    heeds = ("coarse", "starts", "iterations")
    supports = {"points": ANY}
    refusals = REFUSALS
    several = True
    takes_prior = True

    def reads(self, recording):
        return read_by_problem(recording)

    def _estimate(self, recordings, space, budget, key):
        problems = problems_on_points(recordings, space, self.chosen_shape)
        found = descend_weighed(
            problems,
            budget,
            approach=self.name,
            checkpoint=self.checkpoint,
            progress=self.progress,
            key=key,
        )
        return replace(found, shape=self.chosen_shape)


@dataclass(frozen=True, kw_only=True)
class PublishedDiffCP(Method):
    """The public settings of DiffCP, see `published_recipe`."""

    name = "diffcp-published"
    budget = Budget(iterations=EPOCHS)
    heeds = ("iterations",)
    supports = {"points": ANY}
    refusals = REFUSALS

    def reads(self, recording):
        return Reads(frames_that_count(recording), points=POINTS)

    def _estimate(self, recordings, space, budget, key):
        del key  # it starts where the public code does
        (problem,) = problems_on_points(recordings, space, self.chosen_shape)
        found = published_recipe(problem, epochs=budget.iterations, progress=self.progress)
        return replace(found, shape=self.chosen_shape)


def problems_on_points(
    recordings: list[Recording], space: ParameterSpace, shape: tuple[int, int]
) -> tuple[Problem, ...]:
    """The problems of recordings, simulated by material points of a mesh of `shape` vertices."""
    made = (Problem.make(each, space, shape=shape, as_seen=False) for each in recordings)
    return tuple(on_points(each) for each in made)


def on_points(
    problem: Problem,
    spacing: float | None = None,
    membrane_damping: float | None = MEMBRANE_DAMPING,
    forward_mode: bool = False,
) -> Problem:
    """A problem whose motion is simulated by material points, stable for all of its space.

    - `spacing`, `membrane_damping`: see `r2s.scenarios.material_points`.
    - `forward_mode`: allow exact sensitivities, which the default method does not need.

    The sheet's size is taken as written down, since points are laid for one size.

    Make the problem of a sheet that hangs with `as_seen=False`: the points do not settle into the
    shape of their own recording from the shape that the first cloud shows.
    """
    stiffest = problem.space(jnp.ones(problem.space.dim, float))  # limits the time step
    sheet = material_points(problem.scenario, stiffest, spacing, membrane_damping)
    background = dataclasses.replace(sheet.background, forward_mode=forward_mode)
    return dataclasses.replace(
        problem,
        solver=dataclasses.replace(sheet, background=background),
        nuisance_prior=problem.nuisance_prior._replace(size=0.0),
    )


def squared_third(problem: Problem, seen: Prediction) -> Float[Array, ""]:
    """A third of the mean squared distance [m^2] from the clouds to the surface: theirs."""
    if problem.clouds is None:
        raise ValueError("the recipe of DiffCP compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces

    def frame(args):
        points, mask, x = args
        distance, *_ = surface_residuals(points, mask, x, faces)
        return jnp.sum(jnp.where(mask, distance**2, 0)), jnp.sum(mask, dtype=distance.dtype)

    total, count = jax.lax.map(frame, (problem.clouds.points, problem.clouds.mask, seen.x))
    return jnp.sum(total) / jnp.sum(count) / 3


def published_recipe(
    problem: Problem,
    *,
    start: Float[Array, " dim"] | None = None,
    epochs: int = EPOCHS,
    rate: float = RATE,
    progress: Progress | None = None,
) -> Estimate:
    """The public settings: Adam on the exact gradient of `squared_third`.

    It starts from E h = 100 N/m and nu = 0.1, or from `start`. Theirs takes single steps on short
    windows, whose length and rate are not published; this descends on all frames that count. Raises
    `ValueError` for a problem that is not `on_points`.
    """
    if not isinstance(problem.solver, Sheet):
        raise ValueError("DiffCP simulates material points: pass `diffcp.on_points(problem)`")
    if start is None:
        values = ((bound, PUBLISHED_START.get(bound.name)) for bound in problem.space.ranges)
        start = jnp.stack(
            [
                jnp.asarray(0.5, float)
                if value is None
                else bound.to_unit(jnp.asarray(value, float))
                for bound, value in values
            ]
        )
    return adam.descend(
        problem,
        squared_third,
        approach=f"diffcp-published (Adam {rate:g}, {epochs} epochs)",
        start=start,
        epochs=epochs,
        rate=rate,
        reverse=not problem.solver.background.forward_mode,
        progress=progress,
    )
