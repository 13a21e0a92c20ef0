"""The physics-informed network by the contract of `r2s.estimation.method`."""

import dataclasses
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from r2s.estimation.estimate import point_estimate
from r2s.estimation.method import ANY, Budget, Method, Reads, frames_that_count
from r2s.estimation.pinn.pulls import Pull, pull_from, stacked
from r2s.recordings.recording import Recording

if TYPE_CHECKING:
    from r2s.estimation.pinn.from_clouds import Round

REFUSALS = {
    "points": "without markers and force it balances the map of an orthotropic sheet, and the "
    "space of material points is isotropic"
}
CHUNK = 100  # epochs of the published recipe between two losses


@dataclass(frozen=True, kw_only=True)
class PINN(Method):
    """The physics-informed network: from the markers and force of stretchings, or from clouds.

    No solver simulates: "cloth" and "points" tell which space is estimated. `Budget.iterations`
    are the epochs with physics of the networks' training; of clouds the rounds, at most 30.
    """

    name = "pinn"
    budget = Budget(iterations=200)
    heeds = ("iterations",)
    supports = {"cloth": ANY, "points": ("stretching",)}
    refusals = REFUSALS
    several = True
    takes_shape = False

    def check(self, recordings):
        super().check(recordings)
        if len({each.info.scenario == "stretching" for each in recordings}) > 1:
            raise ValueError(
                "pinn takes stretchings, or recordings of other motions, not both: estimate from "
                "each kind alone, or from all by diffcloud"
            )

    def reads(self, recording):
        if recording.info.scenario == "stretching":
            return Reads(frames_that_count(recording), markers=True, force=True)
        from r2s.estimation.pinn import from_clouds  # needs flax

        # some points are matched, all of them show where the sheet ends
        return Reads(from_clouds.frames_of(recording), points=None)

    def _estimate(self, recordings, space, budget, key):
        from r2s.estimation.pinn import from_clouds, from_pulls  # need flax

        if recordings[0].info.scenario == "stretching":
            recipe = dataclasses.replace(from_pulls.QUICK, adam=budget.iterations)
            return from_pulls.estimate(
                pulls_of(recordings),
                space,
                recipe,
                progress=self.progress,
                checkpoint=self.checkpoint,
                key=key,
            ).estimate
        settings = from_clouds.Settings()
        rounds = min(settings.rounds, budget.iterations)
        settings = dataclasses.replace(settings, rounds=rounds)
        return from_clouds.estimate(recordings, space, settings, report=self._report, key=key)

    def _report(self, end: "Round") -> None:
        if self.progress is not None:
            self.progress(end.number, end.spread**2)


@dataclass(frozen=True, kw_only=True)
class PublishedPINN(Method):
    """The recipe of the paper, `r2s.estimation.pinn.published_recipe`, from stretchings.

    It starts in the middle of the space. Without force nothing fixes the scale of the stiffness.
    """

    name = "pinn-published"
    budget = Budget(iterations=10_000)
    heeds = ("iterations",)
    supports = {"cloth": ("stretching",), "points": ("stretching",)}
    several = True
    takes_shape = False

    def reads(self, recording):
        return Reads(frames_that_count(recording), markers=True)

    def _estimate(self, recordings, space, budget, key):
        from r2s.estimation.pinn import published_recipe  # needs flax

        began = time.perf_counter()
        pulls = pulls_of(recordings, without_force=True)
        middle, epochs = jnp.full(space.dim, 0.5, float), budget.iterations
        course = published_recipe.train(
            space, stacked(pulls), middle, epochs, min(CHUNK, epochs), key=key
        )
        if not np.isfinite(course.data[-1]):
            raise RuntimeError("the training of the published recipe diverged")
        history = np.stack([np.asarray(space.values(jnp.asarray(p))) for p in course.places])
        return point_estimate(
            f"pinn-published ({epochs} epochs, no force)",
            space,
            course.model.place,
            float(course.data[-1]),
            course.data[:, None],
            history[:, None],
            time.perf_counter() - began,
        )


def pulls_of(recordings: list[Recording], without_force: bool = False) -> list[Pull]:
    """The pulls of stretchings, each at its own angle to the warp."""
    return [pull_from(recording, without_force=without_force) for recording in recordings]
