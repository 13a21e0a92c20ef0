"""Cross-validation: is an estimate better than the prior on a recording that was held out?

Of three recordings or more one is held out; the prior is that of fabrics of which only the weight
is known (`r2s.materials.prior`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.random as jr
import numpy as np

from r2s._util.units import millimetres
from r2s.compilation import clear_in_time
from r2s.estimation.estimate import Estimate
from r2s.estimation.mesh_refinement import in_mesh_steps
from r2s.materials import prior
from r2s.materials.fabric import Fabric
from r2s.metrics import prediction_error
from r2s.recordings.recording import Recording, clouds_are_markers
from r2s.scenarios.scenario import Scenario, from_recording, in_denser_air

FEWEST = 3  # recordings, of which one is held out without being asked for
NONE = "none"  # the name by which no recording is held out
DRAWS = 8
ALIKE = 1.25  # of the largest error over the least: below, fabrics hardly differ
AIR = "air ratio"  # the nuisance, of `r2s.estimation.prediction`


class HeldOut(NamedTuple):
    """The errors of an estimate and of the prior on a recording that was held out.

    - `recording`: its name. `error`: the mean distance of its points from the estimate's surface,
      over the frames that count, [m]; infinite where the simulation diverged.
    - `defaults`: the same of samples of the prior, without the `diverged` ones, [m]. `middle`: of
      the prior mean, the best guess by the weight.
    - `air`: density of the air in all simulations, relative to the recorded one.
    """

    recording: str
    error: float
    defaults: tuple[float, ...]
    diverged: int
    middle: float
    air: float = 1.0

    @property
    def average(self) -> float:
        """The mean error of the samples; NaN without any."""
        return float(np.mean(self.defaults)) if self.defaults else np.nan

    @property
    def is_better(self) -> bool:
        """Whether the error is less than that of the prior mean, and than the mean of the
        samples; False where none of these ran."""
        return self.error < self.middle and self.error < self.average

    @property
    def is_discriminating(self) -> bool:
        """Whether the motion discriminates: not where samples, prior mean and estimate have about
        the same error (`ALIKE`), as in a fold that lies on the table."""
        others = [error for error in (*self.defaults, self.middle) if np.isfinite(error)]
        least, most = min(others, default=0.0), max(others, default=0.0)
        return most > ALIKE * least or not least / ALIKE <= self.error < ALIKE * most

    def describe(self) -> str:
        """One line: the errors, and what they say; a warning where the prior is as good."""
        diverged = f", {self.diverged} more diverged" if self.diverged else ""
        errors = self.defaults or (np.nan,)
        middle, average, least, most = map(
            millimetres, (self.middle, self.average, min(errors), max(errors))
        )
        error = millimetres(self.error) if np.isfinite(self.error) else "the simulation diverged"
        air = "" if self.air == 1 else f" (all in air {self.air:.2f} times as dense, as found)"
        words = (
            f"held-out motion {self.recording}: mean distance {error}; prior mean "
            f"{middle}; prior samples {average} on average "
            f"({least} to {most}, {len(self.defaults)} samples{diverged}){air}"
        )
        if not self.is_discriminating:
            return f"{words}: fabrics hardly differ in this motion, no verdict"
        if self.is_better:
            others = "every" if self.error < min(self.defaults) else "the average"
            return f"{words}: better than the prior mean and {others} sample"
        rivals = {"the prior mean": self.middle, "the average sample of the prior": self.average}
        better = [name for name, error in rivals.items() if not self.error < error]
        return (
            f"warning: {words}: not better than {' and '.join(better)}, so do not rely on this "
            "estimate in such motions; or the recording is of another fabric"
        )


def choose(recordings: Sequence[Recording], name: str | None = None) -> int | None:
    """The index of the recording to hold out, or None.

    `name`: of the recording, or `NONE`; None: of `FEWEST` recordings or more the last motion with
    clouds, if another is left: no stretching, in which all fabrics look alike, and no fold unless
    there is no other. Raises `ValueError` for an unknown name, for two recordings of that name, for
    one without clouds, and where none would be left.
    """
    if name == NONE:
        return None
    with_clouds = [i for i, recording in enumerate(recordings) if has_clouds(recording)]
    if name is None:
        moving = [i for i in with_clouds if recordings[i].info.scenario != "stretching"]
        best = [i for i in moving if recordings[i].info.scenario != "folding"] or moving
        return best[-1] if len(recordings) >= FEWEST and len(moving) > 1 else None
    names = [recording.info.name for recording in recordings]
    count = names.count(name)
    if count != 1:
        known = ", ".join(names)
        raise ValueError(f"{count or 'no'} recordings are called {name!r}; there are {known}")
    if len(recordings) < 2:
        raise ValueError(f"{name!r} is the only recording: nothing is left to estimate from")
    if names.index(name) not in with_clouds:
        raise ValueError(f"{name!r} has no clouds to be judged by")
    return names.index(name)


def why_none(recordings: Sequence[Recording], name: str | None = None) -> str:
    """Why `choose` holds none of several recordings out."""
    if name == NONE:
        return "none was to be held out"
    if len(recordings) < FEWEST:
        return f"{FEWEST} recordings or more hold one out, these are {len(recordings)}"
    return (
        "two motions with clouds in all frames are needed to hold one out, beside stretchings, "
        "which look alike of any fabric"
    )


def has_clouds(recording: Recording) -> bool:
    """Whether it has clouds, and not its markers in their place, in every frame that counts."""
    first, last = recording.info.frames_used
    counts = np.count_nonzero(np.asarray(recording.mask), axis=1)[first : last + 1]
    return bool(np.all(counts > 0)) and not clouds_are_markers(recording)


def judge(
    recording: Recording,
    fabric: Fabric,
    shape: tuple[int, int],
    count: int = DRAWS,
    air: float = 1.0,
) -> HeldOut:
    """The errors of a fabric, of the prior mean of its density and of `count` samples of the
    prior, in a recording.

    All are simulated by the cloth on a mesh of `shape`, in the steps of an estimate
    (`r2s.estimation.mesh_refinement.in_mesh_steps`), with `air` times the density of the air. Size
    and cameras are as written down.
    """
    clear_in_time()
    density = float(fabric.density)
    fabrics = (fabric, prior.middle(density), *prior.fabrics(density, count, jr.key(0)))
    error, middle, *others = (_error(recording, one, shape, air) for one in fabrics)
    finite = tuple(other for other in others if np.isfinite(other))
    return HeldOut(recording.info.name, error, finite, count - len(finite), middle, air)


def air_found(estimate: Estimate, recordings: Sequence[Recording]) -> float:
    """The estimated density of the air, relative to the recorded one, where one of the estimate's
    recordings says that it is uncertain; else 1: a wind alone determines only its own speed."""
    doubts = [recording.info.doubt for recording in recordings]
    if not any(doubt is not None and doubt.air for doubt in doubts):
        return 1.0
    # a method that reports no nuisances has not changed the air
    return next((n.value for n in estimate.nuisances if n.name == AIR), 1.0)


def in_steps(recording: Recording, shape: tuple[int, int], air: float = 1.0) -> Scenario:
    """The scenario of a recording on a mesh of `shape` vertices in the steps of an estimate, with
    `air` times the density of the air [-]."""
    scenario = in_denser_air(from_recording(recording, shape), air)
    return in_mesh_steps(scenario, recording.info.scenario, shape)


def _error(recording: Recording, fabric: Fabric, shape: tuple[int, int], air: float) -> float:
    x = prediction_error.predict_motion(in_steps(recording, shape, air), fabric).x
    away = prediction_error.from_surface(recording, x, shape)
    return float(np.mean(away)) if np.isfinite(away).all() else float("inf")
