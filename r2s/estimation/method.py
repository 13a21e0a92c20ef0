"""One contract for all estimators: recordings of a fabric in, an `Estimate` out.

    estimate = METHODS["diffcloud"]().estimate(recordings, space, key=jax.random.key(0))

A method is a frozen dataclass, whose fields are what it needs beyond recordings, space, budget and
key. `r2s.estimation.methods.METHODS` has all methods.
"""

import abc
import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s.estimation.default_spaces import on_cloth, on_mpm
from r2s.estimation.estimate import Estimate, Fit
from r2s.materials.parameters import InformedSpace, ParameterSpace
from r2s.recordings.checks import mean_distance, point_noise
from r2s.recordings.recording import Recording, clouds_are_markers
from r2s.scenarios.resolution import mesh_error

SOLVERS = ("cloth", "mpm")
COARSEST = (9, 9)  # vertices of a simulated sheet
ANY = None  # every scenario
Progress = Callable[[int, float], None]  # called with the iteration and the best loss


def tell(progress: Progress | None, words: str) -> None:
    """Report the current step to a progress that has a method `say`."""
    say = getattr(progress, "say", None)
    if say is not None:
        say(words)


class Budget(NamedTuple):
    """How much an estimate may cost. Each method uses some of these, see `Method.budget_fields`.

    - `num_samples`: of the parameter range that are tried first; 0: only the start.
    - `num_starts`: descents, from the best samples. Of more than three, the better half continue
      after every three iterations, until three are left.
    - `max_iterations`: of each stage of a descent. First all starts descend; then the best one
      descends with outliers left out, until its next step would change no parameter by more than
      about a tenth of its standard error. Of a method that trains: its epochs.
    - `secant_width`: over which slopes are taken, see `r2s.estimation.prediction.sensitivities`;
      None: exact derivatives.
    - `frame_fractions`: of the frames, from the first, that count in earlier stages. The end of a
      long motion can depend so steeply on the fabric that a loss over all of it is low only near
      the truth; that of its beginning is smoother.
    - `num_probes`: an even number of places around the end, from which Gauss-Newton steps are
      taken; the standard errors grow with the scatter of the ends of these steps.
    - `max_evaluations`: simulations of a search without derivatives.
    - `is_intermediate`: whether a descent on a finer mesh starts at the end, which may be less
      exact.
    - `warm_start`: whether the start is near the end: outliers are left out from the first step.
    """

    num_samples: int = 24
    num_starts: int = 3
    max_iterations: int = 25
    secant_width: float | None = None
    frame_fractions: tuple[float, ...] = ()
    num_probes: int = 8
    max_evaluations: int = 80
    is_intermediate: bool = False
    warm_start: bool = False


class DataRequirements(NamedTuple):
    """The data of a recording that a method reads, beside its sheet, table, wind and the grippers'
    path: clouds (`points` of each at most; None: all), markers and force in some `frames`."""

    frames: tuple[int, ...]
    points: int | None = 0
    markers: bool = False
    force: bool = False


def frames_that_count(recording: Recording) -> tuple[int, ...]:
    """All used frames of a recording."""
    first, last = recording.info.frames_used
    return tuple(range(first, last + 1))


@dataclass(frozen=True, kw_only=True)
class Method(abc.ABC):
    """A way to estimate a fabric.

    Of every method:

    - `name`: in the registry. `budget`: its default. `budget_fields`: those that it uses.
    - `supports`: by solver the scenarios that it estimates from; None: all of them.
    - `refusals`: by solver why it does not support it.
    - `several`: whether it takes more than one recording of a fabric.
    - `takes_prior`: whether it uses the prior of an `InformedSpace`.
    - `takes_shape`: whether the `shape` of its simulated sheet can be chosen.

    Of one instance:

    - `solver`: "cloth", or "mpm" (material points); None: the first that the method supports.
    - `shape`: vertices of the simulated sheet along warp and weft; None: those of the method
      (`diffcloud`: by meshes that resolve the fabric, see `r2s.estimation.mesh_refinement`).
    - `checkpoint`: a file that a killed run resumes from; None: it begins again.
    - `progress`: called with the iteration and the best loss so far, see also `tell`.
    """

    name: ClassVar[str]
    budget: ClassVar[Budget]
    budget_fields: ClassVar[tuple[str, ...]]
    supports: ClassVar[Mapping[str, tuple[str, ...] | None]]
    refusals: ClassVar[Mapping[str, str]] = {}
    several: ClassVar[bool] = False
    takes_prior: ClassVar[bool] = False
    takes_shape: ClassVar[bool] = True

    solver: str | None = None
    shape: tuple[int, int] | None = None
    checkpoint: Path | None = None
    progress: Progress | None = None

    def estimate(
        self,
        recordings: Sequence[Recording],
        space: ParameterSpace,
        budget: Budget | None = None,
        *,
        key: PRNGKeyArray,
    ) -> Estimate:
        """The fabric of `space` that explains the recordings, all of one fabric.

        Raises `ValueError` that says why for what the method does not support (see `check`) or a
        recording that it cannot use, `RuntimeError` when every simulation diverges, and
        `ImportError` that names the extra to install.
        """
        self.check(recordings)
        if isinstance(space, InformedSpace):
            self.check_prior()
        began = time.perf_counter()
        estimate = self._estimate(list(recordings), space, budget or self.budget, key)
        pairs = zip(estimate.fits, recordings, strict=False)
        errors = np.sqrt(np.diag(np.linalg.inv(np.asarray(space.prior()[1], float))))
        errors = errors * [bound.width for bound in space.ranges]
        return dataclasses.replace(
            estimate,
            fits=tuple(allowance(fit, recording, estimate) for fit, recording in pairs),
            # a recipe may estimate other parameters than those of the space, such as multipliers
            prior_errors=errors if estimate.ranges == space.ranges else np.zeros(0),
            seconds=max(estimate.seconds, time.perf_counter() - began),  # of a resumed run
        )

    def check(self, recordings: Sequence[Recording]) -> None:
        """Raise `ValueError` that says why if the method does not support these recordings."""
        if not recordings:
            raise ValueError(f"{self.name} needs a recording")
        if len(recordings) > 1 and not self.several:
            raise ValueError(f"{self.name} takes one recording, got {len(recordings)}")
        for recording in recordings:
            if reason := self.refusal(self.chosen_solver, recording.info.scenario):
                raise ValueError(f"{self.name}: {reason}")

    def check_prior(self) -> None:
        """Raise `ValueError` if the method does not support priors."""
        if not self.takes_prior:
            raise ValueError(f"{self.name} does not support priors (InformedSpace)")

    @property
    def chosen_solver(self) -> str:
        """The solver of this instance, or the first that the method supports."""
        return self.solver or next(iter(self.supports))

    @property
    def chosen_shape(self) -> tuple[int, int]:
        """The shape of this instance, or `COARSEST`."""
        return self.shape or COARSEST

    @abc.abstractmethod
    def reads(self, recording: Recording) -> DataRequirements:
        """The data of a recording on which an estimate depends."""

    @classmethod
    def options(cls) -> frozenset[str]:
        """Names of the fields that this method has beside those of all methods."""
        own, shared = ({field.name for field in dataclasses.fields(c)} for c in (cls, Method))
        return frozenset(own - shared)

    @classmethod
    def refusal(cls, solver: str, scenario: str) -> str:
        """Why the method does not estimate from a scenario on a solver; empty: it does."""
        if solver not in SOLVERS:
            return f"a solver is one of {', '.join(SOLVERS)}, got {solver!r}"
        if solver not in cls.supports:
            return cls.refusals[solver]
        scenarios = cls.supports[solver]
        if scenarios is None or scenario in scenarios:
            return ""
        reason = f"on {solver} it estimates from {', '.join(scenarios)}, not from {scenario}"
        return f"{reason}: {cls.refusals[solver]}" if solver in cls.refusals else reason

    @abc.abstractmethod
    def _estimate(
        self,
        recordings: list[Recording],
        space: ParameterSpace,
        budget: Budget,
        key: PRNGKeyArray,
    ) -> Estimate:
        """`estimate` of recordings that were checked."""


def allowance(fit: Fit, recording: Recording, estimate: Estimate) -> Fit:
    """A fit with the name and the noise of its recording, and the error of the estimate's mesh."""
    info, noise, mesh = recording.info, math.nan, math.nan
    if not clouds_are_markers(recording):
        noise = mean_distance(point_noise(recording))
    if estimate.shape is not None:
        mesh = mesh_error(estimate.fabric, info.sheet.size, estimate.shape, info.scenario)
    return fit._replace(recording=info.name, noise=noise, mesh=mesh)


def default_space(solver: str, density: float) -> ParameterSpace:
    """The default space of a solver (`r2s.estimation.default_spaces`): orthotropic on the cloth,
    isotropic on material points. `density`: areal, [kg/m^2], else `ValueError`."""
    return on_cloth(density) if solver == "cloth" else on_mpm(density)


def seed_of(key: PRNGKeyArray) -> int:
    """A seed for generators of other libraries; that of `jax.random.key(seed)` is `seed`."""
    return int(np.asarray(jax.random.key_data(key)).ravel()[-1])
