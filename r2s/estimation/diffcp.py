"""DiffCP: a fabric from point clouds, by differentiating through material points.

After Zheng et al. 2024 ("Differentiable cloth parameter identification and state estimation in
manipulation"), whom the study follows. `estimate` is r2s's default, by Gauss-Newton with slopes
over a width of the range; `original` has the public settings.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import adam
from r2s.estimation.descent import Budget, Progress, descend
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import Joint
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import Problem
from r2s.evaluation.losses import surface_residuals
from r2s.fabrics.fabric import Fabric
from r2s.mpm.sheet import Sheet
from r2s.scenarios.on_points import MEMBRANE_DAMPING, material_points

WIDTH = 0.02  # of the range: the slope of the exact motion is rough below that
FIRST = {"E h": 100.0, "nu": 0.1}  # where the public code starts
EPOCHS, RATE = 51, 0.05
DEFAULT = Budget(coarse=12, starts=2, width=WIDTH, around=4)


def on_points(
    problem: Problem,
    spacing: float | None = None,
    membrane_damping: float | None = MEMBRANE_DAMPING,
    forward_mode: bool = False,
) -> Problem:
    """A problem whose motion is simulated by material points, stable for all of its space.

    Arguments as of `r2s.scenarios.material_points`; `forward_mode` for exact sensitivities, which
    the default estimator does not need. A sheet that hangs is to be made with `as_seen=False`: the
    points do not settle into the shape that their own recording shows from the one laid onto it.
    """
    sheet = material_points(problem.scenario, stiffest(problem), spacing, membrane_damping)
    background = dataclasses.replace(sheet.background, forward_mode=forward_mode)
    return dataclasses.replace(problem, solver=dataclasses.replace(sheet, background=background))


def stiffest(problem: Problem) -> Fabric:
    """The fabric at the upper ends of the ranges, which limits the time step."""
    return problem.space(jnp.ones(problem.space.dim, float))


def estimate(
    problems: Problem | Joint,
    budget: Budget = DEFAULT,
    *,
    start: Float[Array, " dim"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of recordings whose problems are `on_points`, by `descent.descend`.

    Raises `ValueError` for a problem on another solver.
    """
    for problem in (problems,) if isinstance(problems, Problem) else problems:
        if not isinstance(problem.solver, Sheet):
            raise ValueError("DiffCP simulates material points: pass `diffcp.on_points(problem)`")
    return descend(
        problems,
        budget,
        approach="diffcp",
        start=start,
        checkpoint=checkpoint,
        progress=progress,
        key=key,
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


def original(
    problem: Problem,
    *,
    start: Float[Array, " dim"] | None = None,
    epochs: int = EPOCHS,
    rate: float = RATE,
    progress: Progress | None = None,
) -> Estimate:
    """The recipe: Adam on the exact gradient of `squared_third`, from E h = 100 N/m, nu = 0.1.

    Theirs takes single steps on short windows, whose length and rate are not published; this
    descends on all frames that count. Start and loss are theirs. Needs a problem `on_points`.
    """
    if not isinstance(problem.solver, Sheet):
        raise ValueError("DiffCP simulates material points: pass `diffcp.on_points(problem)`")
    if start is None:
        pairs = [(bound, FIRST.get(bound.name)) for bound in problem.space.ranges]
        place = [0.5 if v is None else float(b.place(jnp.asarray(v, float))) for b, v in pairs]
        start = jnp.asarray(place, float)
    return adam.descend(
        problem,
        squared_third,
        approach=f"diffcp_original (Adam {rate:g}, {epochs} epochs)",
        start=start,
        epochs=epochs,
        rate=rate,
        reverse=not problem.solver.background.forward_mode,
        progress=progress,
    )
