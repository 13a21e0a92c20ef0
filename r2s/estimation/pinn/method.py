"""The physics-informed network by the contract of `r2s.estimation.method`."""

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from r2s.estimation.estimate import point_estimate
from r2s.estimation.method import Budget, DataRequirements, Method, frames_that_count
from r2s.estimation.pinn.pulls import pull_from, stacked

ALONE = (
    "the network from clouds was tried and does not find the fabric, so the PINN estimates from "
    "stretchings alone"
)
CHUNK = 100  # epochs of the published recipe between two losses


@dataclass(frozen=True, kw_only=True)
class PINN(Method):
    """The physics-informed network, from the markers and force of stretchings.

    No solver simulates: "cloth" and "mpm" are names of the space. `Budget.max_iterations` is the
    number of epochs with physics in the networks' training.
    """

    name = "pinn"
    budget = Budget(max_iterations=200)
    budget_fields = ("max_iterations",)
    supports = {"cloth": ("stretching",), "mpm": ("stretching",)}
    refusals = {"cloth": ALONE, "mpm": ALONE}
    several = True
    takes_shape = False

    def reads(self, recording):
        return DataRequirements(frames_that_count(recording), markers=True, force=True)

    def _estimate(self, recordings, space, budget, key):
        from r2s.estimation.pinn.estimator import estimate  # needs flax
        from r2s.estimation.pinn.training import Recipe

        pulls = [pull_from(recording) for recording in recordings]
        return estimate(
            pulls,
            space,
            Recipe(adam=budget.max_iterations),
            progress=self.progress,
            checkpoint=self.checkpoint,
            key=key,
        )


@dataclass(frozen=True, kw_only=True)
class PublishedPINN(PINN):
    """The recipe of the paper, `r2s.estimation.pinn.published_recipe`, from stretchings.

    It starts in the middle of the space. Without force nothing fixes the scale of the stiffness.
    """

    name = "pinn-published"
    budget = Budget(max_iterations=10_000)
    refusals = {}

    def reads(self, recording):
        return DataRequirements(frames_that_count(recording), markers=True)

    def _estimate(self, recordings, space, budget, key):
        from r2s.estimation.pinn import published_recipe  # needs flax

        began, epochs = time.perf_counter(), budget.max_iterations
        pulls = [pull_from(recording, without_force=True) for recording in recordings]
        train = published_recipe.train
        trained = train(space, stacked(pulls), epochs, min(CHUNK, epochs), key=key)
        losses = trained.losses
        if not np.isfinite(losses[-1]):
            raise RuntimeError("the training of the published recipe diverged")
        history = np.asarray(jax.vmap(space.values)(jnp.asarray(trained.places, float)))
        return point_estimate(
            f"pinn-published ({epochs} epochs, no force)",
            space,
            trained.model.place,
            float(losses[-1]),
            losses[:, None],
            history[:, None],
            time.perf_counter() - began,
        )
