"""DIFFCLOUD, DiffCP, CMA-ES and the published recipes by the contract of `Method`; all `METHODS`.

- DIFFCLOUD: Sundaresan, Antonova and Bohg 2022 ("DiffCloud: Real-to-Sim from Point Clouds with
  Differentiable Simulation and Rendering of Deformable Objects").
- DiffCP: Zheng et al. 2024 ("Differentiable cloth parameter identification and state estimation in
  manipulation").
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp

from r2s._util.extras import require
from r2s.estimation import baselines, descent
from r2s.estimation.mesh_refinement import descend_by_meshes, descend_weighted
from r2s.estimation.method import ANY, Budget, DataRequirements, Method, frames_that_count
from r2s.estimation.physnet.method import PhysNetMethod, PublishedPhysNet
from r2s.estimation.pinn.method import PINN, PublishedPINN
from r2s.estimation.problem import POINTS, Problem, read_by_problem
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.recording import Recording
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import from_recording

WIDTH = 0.02  # of the range: the slope of exact material points is rough below that
SEARCHED = ("num_samples", "num_starts", "max_iterations")
NO_POINTS = {"mpm": "it differentiates through the cloth; on material points take diffcp"}
NO_CLOTH = {"cloth": "it differentiates through material points; on the cloth take diffcloud"}


@dataclass(frozen=True, kw_only=True)
class DiffCloud(Method):
    """The method of DIFFCLOUD: Gauss-Newton descents through the cloth.

    - `finest`: continues on the finest mesh, whichever fabric is found on the coarser: minutes
      instead of one, and right where the fabric's folds decide (docs/guide/estimate.md).
    """

    name = "diffcloud"
    budget = descent.DEFAULT._replace(num_samples=0, num_starts=1)
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
        return descend_by_meshes(
            recordings,
            space,
            budget,
            shape=self.shape,
            finest=self.finest,
            checkpoint=self.checkpoint,
            progress=self.progress,
            key=key,
        )


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
        problems = problems_on_mpm(recordings, space, self.chosen_shape)
        found = descend_weighted(
            problems,
            budget,
            approach=self.name,
            checkpoint=self.checkpoint,
            progress=self.progress,
            key=key,
        )
        return dataclasses.replace(found, shape=self.chosen_shape)


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
        found = baselines.cma_es(problems, budget.max_evaluations, progress=self.progress, key=key)
        return dataclasses.replace(found, shape=shape)


@dataclass(frozen=True, kw_only=True)
class PublishedDiffCloud(Method):
    """The recipe of the DIFFCLOUD paper, `r2s.estimation.baselines.diffcloud_recipe`.

    - `assumed`: the fabric whose stiffness and mass are multiplied; None: the middle of the space.
    """

    name = "diffcloud-published"
    budget = Budget(max_iterations=baselines.EPOCHS)
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
        assumed = space.middle() if self.assumed is None else self.assumed
        found = baselines.diffcloud_recipe(problem, assumed, budget.max_iterations, self.progress)
        return dataclasses.replace(found, shape=self.chosen_shape)


@dataclass(frozen=True, kw_only=True)
class PublishedDiffCP(Method):
    """The public settings of DiffCP, `r2s.estimation.baselines.diffcp_recipe`."""

    name = "diffcp-published"
    budget = Budget(max_iterations=baselines.EPOCHS)
    budget_fields = ("max_iterations",)
    supports = {"mpm": ANY}
    refusals = NO_CLOTH

    def reads(self, recording):
        return DataRequirements(frames_that_count(recording), points=POINTS)

    def _estimate(self, recordings, space, budget, key):
        del key  # it starts where the public code does
        (problem,) = problems_on_mpm(recordings, space, self.chosen_shape)
        found = baselines.diffcp_recipe(problem, budget.max_iterations, self.progress)
        return dataclasses.replace(found, shape=self.chosen_shape)


def problems_on_mpm(
    recordings: Sequence[Recording], space: ParameterSpace, shape: tuple[int, int]
) -> tuple[Problem, ...]:
    """The problems of recordings, simulated by material points of a mesh of `shape` vertices,
    stable for all of the space.

    The sheet's size is taken as written down, since points are laid out for one size. A sheet that
    hangs starts flat: points do not settle into the shape that its first cloud shows.
    """
    stiffest = space(jnp.ones(space.dim, float))  # limits the time step
    problems = []
    for each in recordings:
        problem = Problem.make(each, space, shape=shape, as_seen=False)
        sheet = mpm_cloth(problem.scenario, stiffest)
        background = dataclasses.replace(sheet.background, forward_mode=False)
        exact_size = problem.nuisance_prior._replace(size=0.0)
        solver = dataclasses.replace(sheet, background=background)
        problems.append(dataclasses.replace(problem, solver=solver, nuisance_prior=exact_size))
    return tuple(problems)


METHODS: dict[str, type[Method]] = {
    method.name: method
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
}
"""All methods by name, for the command line and the study."""
