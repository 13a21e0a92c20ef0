"""DIFFCLOUD: a fabric from point clouds, by differentiating through the cloth and its surface.

After Sundaresan, Antonova and Bohg 2022 ("DiffCloud: Real-to-Sim from Point Clouds with
Differentiable Simulation and Rendering of Deformable Objects"). `DiffCloud` is r2s's default
method, by Gauss-Newton descents; `PublishedDiffCloud` follows their recipe.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimation import adam
from r2s.estimation.descent import DEFAULT
from r2s.estimation.estimate import Estimate
from r2s.estimation.mesh_ladder import descend_by_meshes
from r2s.estimation.method import ANY, Budget, Method, Progress, Reads, frames_that_count
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import POINTS, Problem, read_by_problem
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Range
from r2s.mesh.surface import sample
from r2s.metrics.losses import one_sided_chamfer
from r2s.scenarios.scenario import from_recording

STRETCH = Range("stretch multiplier", "-", 0.05, 10.0, log=False)
MASS = Range("mass multiplier", "-", 0.1, 10.0, log=False)
EPOCHS, RATE = 51, 0.2
RESOLUTION = 5  # squared, samples on a face: 3,200 of theirs 3,500 on 128 faces
RECIPE = "Adam 0.2, 51 epochs, 3,200 samples, last frame"
REFUSALS = {"points": "it differentiates through the cloth; on material points take diffcp"}


@dataclass(frozen=True, kw_only=True)
class DiffCloud(Method):
    """The method of DIFFCLOUD: Gauss-Newton descents through the cloth.

    - `finest`: goes on to the finest mesh, whichever fabric is found on the coarsest: minutes
      instead of one, and right where the fabric's folds decide (docs/estimators.md).
    """

    name = "diffcloud"
    budget = DEFAULT._replace(coarse=0, starts=1)
    heeds = ("coarse", "starts", "iterations")
    supports = {"cloth": ANY}
    refusals = REFUSALS
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
class PublishedDiffCloud(Method):
    """The recipe of the DIFFCLOUD paper, see `published_recipe`.

    - `assumed`: the fabric whose stiffness and mass are multiplied; None: the middle of the space.
    """

    name = "diffcloud-published"
    budget = Budget(iterations=EPOCHS)
    heeds = ("iterations",)
    supports = {"cloth": ANY}
    refusals = REFUSALS

    assumed: Fabric | None = None

    def reads(self, recording):
        first, *_, last = (0, *frames_that_count(recording))
        hangs = from_recording(recording, self.chosen_shape).brake is not None
        is_shown = hangs and recording.info.frames_used[0] == 0  # how it hangs at first
        return Reads((first, last) if is_shown else (last,), points=POINTS)

    def _estimate(self, recordings, space, budget, key):
        del key  # it starts in the middle
        problem = Problem.make(recordings[0], space, shape=self.chosen_shape)
        assumed = space.middle() if self.assumed is None else self.assumed
        found = published_recipe(problem, assumed, epochs=budget.iterations, progress=self.progress)
        return dataclasses.replace(found, shape=self.chosen_shape)


class MultiplierSpace(ParameterSpace):
    """Fabrics that are an assumed one but for two multipliers, as in the DIFFCLOUD paper.

    One multiplies all membrane stiffness, one the mass (theirs the mass of 20 listed vertices, ours
    of all).
    """

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


def published_recipe(
    problem: Problem,
    assumed: Fabric | None,
    *,
    start: Float[Array, " dim"] | None = None,
    epochs: int = EPOCHS,
    rate: float = RATE,
    progress: Progress | None = None,
) -> Estimate:
    """The recipe of the DIFFCLOUD paper: two multipliers of an assumed fabric, by Adam.

    One multiplies all membrane stiffness (0.05 to 10), one the mass (0.1 to 10), through a sigmoid
    from the middle of the range or from `start`. The loss is `last_frame`. With no `assumed` fabric
    the same optimiser and loss find all parameters of the problem's space. Gives no standard
    errors.
    """
    if assumed is not None:
        problem = dataclasses.replace(problem, space=MultiplierSpace(assumed=assumed))
    words = RECIPE if assumed is not None else f"{RECIPE}, all parameters"
    return adam.descend(
        problem,
        last_frame,
        approach=f"diffcloud-published ({words})",
        start=start,
        epochs=epochs,
        rate=rate,
        progress=progress,
    )
