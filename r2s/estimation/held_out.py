"""Cross-validation: is an estimate better than the prior on a recording that it was not made from?

Of three recordings or more one is held out; the prior is that of fabrics of which only the weight
is known (`r2s.materials.prior`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.random as jr
import numpy as np

from r2s.compilation import clear_in_time
from r2s.estimation.estimate import Estimate
from r2s.estimation.mesh_refinement import in_mesh_steps
from r2s.materials import prior
from r2s.materials.fabric import Fabric
from r2s.metrics import prediction_error
from r2s.recordings.recording import Recording, clouds_are_markers
from r2s.scenarios.scenario import from_recording, in_denser_air

FEWEST = 3  # recordings, of which one is held out without being asked for
NONE = "none"  # the name by which no recording is held out
DRAWS = 8
ALIKE = 1.25  # of the largest error over the least: less, and all fabrics look alike
AIR = "air ratio"  # the nuisance, of `r2s.estimation.prediction`


class HeldOut(NamedTuple):
    """The errors of an estimate and of the prior on a recording that was held out.

    - `recording`: its name. `error`: the mean distance of its points from the estimate's surface,
      over the frames that count, [m]; infinite where the simulation diverged.
    - `defaults`: the same of samples of the prior, without the `diverged` ones, [m]. `middle`: of
      the prior mean, the best guess by the weight.
    - `air`: density of the air that all of them moved in, relative to that written down.
    """

    recording: str
    error: float
    defaults: tuple[float, ...]
    diverged: int
    middle: float
    air: float = 1.0

    @property
    def is_better(self) -> bool:
        """Whether the error is less than that of the prior mean, and than the mean of the
        samples; False where none of these ran."""
        return bool(self.defaults) and self.error < min(float(np.mean(self.defaults)), self.middle)

    @property
    def is_discriminating(self) -> bool:
        """Whether the motion discriminates: not where samples, prior mean and estimate are alike
        in it (`ALIKE`), as in a fold that lies on the table."""
        others = [each for each in (*self.defaults, self.middle) if np.isfinite(each)]
        least, most = min(others, default=0.0), max(others, default=0.0)
        return most > ALIKE * least or not least / ALIKE <= self.error < ALIKE * most

    def describe(self) -> str:
        """One line: the errors, and what they say; a warning where the prior is as good."""
        lost = f", {self.diverged} more diverged" if self.diverged else ""
        errors = np.array(self.defaults or (np.nan,))
        least, most, mean = (_mm(each) for each in (errors.min(), errors.max(), errors.mean()))
        error = f"{_mm(self.error)} mm" if np.isfinite(self.error) else "the simulation diverged"
        air = "" if self.air == 1 else f" (all in air {self.air:.2f} times as dense, as found)"
        words = (
            f"held-out motion {self.recording}: mean distance {error}; prior mean "
            f"{_mm(self.middle)} mm; prior samples {mean} mm on average ({least} to {most}, "
            f"{len(self.defaults)} samples{lost}){air}"
        )
        if not self.is_discriminating:
            return f"{words}: fabrics hardly differ in this motion, no verdict"
        if self.is_better:
            others = "every" if self.error < min(self.defaults) else "the average"
            return f"{words}: better than the prior mean and {others} sample"
        return (
            f"warning: {words}: not better than {' and '.join(self._not_beaten)}, so do not rely "
            "on this estimate in such motions; or the recording is of another fabric"
        )

    @property
    def _not_beaten(self) -> list[str]:
        """Which of the prior's two errors this one is not below."""
        average = float(np.mean(self.defaults)) if self.defaults else -np.inf
        pairs = (self.middle, "the prior mean"), (average, "the average sample of the prior")
        return [name for other, name in pairs if not self.error < other]


def choose(recordings: Sequence[Recording], name: str | None = None) -> int | None:
    """The index of the recording to hold out, or None.

    `name`: of the recording, or `NONE`; None: of `FEWEST` recordings or more the last motion with
    clouds, if another is left: no stretching, in which all fabrics look alike, and no fold unless
    there is no other. Raises `ValueError` for an unknown name, for two recordings of that name, for
    one without clouds, and where none would be left.
    """
    if name == NONE:
        return None
    with_clouds = [i for i, each in enumerate(recordings) if has_clouds(each)]
    if name is None:
        moving = [i for i in with_clouds if recordings[i].info.scenario != "stretching"]
        telling = [i for i in moving if recordings[i].info.scenario != "folding"] or moving
        return telling[-1] if len(recordings) >= FEWEST and len(moving) > 1 else None
    found = [i for i, each in enumerate(recordings) if each.info.name == name]
    if len(found) != 1:
        known = ", ".join(each.info.name for each in recordings)
        raise ValueError(f"{len(found) or 'no'} recordings are called {name!r}; there are {known}")
    if len(recordings) < 2:
        raise ValueError(f"{name!r} is the only recording: nothing is left to estimate from")
    if found[0] not in with_clouds:
        raise ValueError(f"{name!r} has no clouds to be judged by")
    return found[0]


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
    each = (fabric, prior.middle(density), *prior.fabrics(density, count, jr.key(0)))
    error, middle, *others = (_error(recording, one, shape, air) for one in each)
    finite = tuple(other for other in others if np.isfinite(other))
    return HeldOut(recording.info.name, error, finite, count - len(finite), middle, air)


def air_found(estimate: Estimate, recordings: Sequence[Recording]) -> float:
    """The estimated density of the air, relative to that written down, where one of the estimate's
    recordings doubts it; else 1: a wind alone determines only its own speed."""
    if not any(each.info.doubt is not None and each.info.doubt.air for each in recordings):
        return 1.0
    # a method that reports no nuisances has left the air as it was written down
    return next((each.value for each in estimate.nuisances if each.name == AIR), 1.0)


def _error(recording: Recording, fabric: Fabric, shape: tuple[int, int], air: float) -> float:
    scenario = in_denser_air(from_recording(recording, shape), air)
    scenario = in_mesh_steps(scenario, recording.info.scenario, shape)
    x = prediction_error.predict_motion(scenario, fabric).x
    away = prediction_error.from_surface(recording, x, shape)
    return float(np.mean(away)) if np.isfinite(away).all() else float("inf")


def _mm(value: float | np.floating) -> str:
    return f"{1e3 * float(value):.1f}" if np.isfinite(value) else "-"
