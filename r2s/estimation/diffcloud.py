"""DIFFCLOUD: a fabric from point clouds, by differentiating through the cloth and its surface.

After Sundaresan, Antonova and Bohg 2022 ("DiffCloud: Real-to-Sim from Point Clouds with
Differentiable Simulation and Rendering of Deformable Objects"). `estimate` is r2s's default;
`original` follows their recipe, `recipe` its optimiser and loss for all parameters of a space.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import adam
from r2s.estimation.descent import DEFAULT, Budget, Progress, descend
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import Joint
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import Problem
from r2s.evaluation.losses import one_sided_chamfer
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import ParameterSpace, Range
from r2s.geometry.surface import sample

STRETCH = Range("stretch multiplier", "-", 0.05, 10.0, log=False)
MASS = Range("mass multiplier", "-", 0.1, 10.0, log=False)
EPOCHS, RATE = 51, 0.2
RESOLUTION = 5  # squared, samples on a face: 3,200 of theirs 3,500 on 128 faces
RECIPE = "Adam 0.2, 51 epochs, 3,200 samples, last frame"


def estimate(
    problems: Problem | Joint,
    budget: Budget = DEFAULT,
    *,
    start: Float[Array, " dim"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of a recording, or of several, by `r2s.estimation.descent.descend`."""
    return descend(
        problems,
        budget,
        approach="diffcloud",
        start=start,
        checkpoint=checkpoint,
        progress=progress,
        key=key,
    )


class Multiplied(ParameterSpace):
    """Fabrics that are an assumed one but for two multipliers, as in the DIFFCLOUD paper.

    One of all membrane stiffness, one of the mass (theirs of 20 listed vertices, ours of all).
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

    def locate(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric with multiples of the assumed one's C11 and density lies."""
        stretch = STRETCH.place(fabric.membrane.c11 / self.assumed.membrane.c11)
        return jnp.stack([stretch, MASS.place(fabric.density / self.assumed.density)])


def last_frame(problem: Problem, seen: Prediction) -> Float[Array, ""]:
    """Mean squared distance [m^2] from samples of the simulated surface to the last cloud."""
    if problem.clouds is None:
        raise ValueError("the recipe of DIFFCLOUD compares clouds: the recording has none")
    faces = problem.scenario.scene.mesh.faces
    surface = sample(seen.x[-1], faces, RESOLUTION)
    points, mask = problem.clouds.points[-1], problem.clouds.mask[-1]
    targets = jnp.where(mask[:, None], points, jnp.inf)  # padding is never the nearest
    return one_sided_chamfer(surface, jnp.ones(surface.shape[0], bool), targets)


def original(
    problem: Problem,
    assumed: Fabric,
    *,
    epochs: int = EPOCHS,
    rate: float = RATE,
    progress: Progress | None = None,
) -> Estimate:
    """The recipe of the DIFFCLOUD paper: two multipliers of an assumed fabric, by Adam.

    One multiplies all membrane stiffness (0.05 to 10), one the mass (0.1 to 10), through a sigmoid
    from the middle of the range. The loss is `last_frame`. Gives no deviations.
    """
    two = dataclasses.replace(problem, space=Multiplied(assumed=assumed))
    name = f"diffcloud_original ({RECIPE})"
    return adam.descend(two, last_frame, approach=name, epochs=epochs, rate=rate, progress=progress)


def recipe(
    problem: Problem,
    *,
    start: Float[Array, " dim"] | None = None,
    epochs: int = EPOCHS,
    rate: float = RATE,
    progress: Progress | None = None,
) -> Estimate:
    """The same optimiser and loss, for all parameters of the problem's space, from any start."""
    return adam.descend(
        problem,
        last_frame,
        approach=f"diffcloud_recipe ({RECIPE})",
        start=start,
        epochs=epochs,
        rate=rate,
        progress=progress,
    )
