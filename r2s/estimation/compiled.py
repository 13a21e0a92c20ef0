"""Loss and normal equations at many thetas, in compiled programs.

What moves is compiled apart from what was seen of it, which is most of the work: one such program
serves recordings of any number of points, all stages of a descent, and its end.
"""

import math
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.threads import thread_map
from r2s.compilation import compile_once
from r2s.estimation import gauss_newton
from r2s.estimation.gauss_newton import Normal, Problems, theta_indices
from r2s.estimation.method import Progress, tell
from r2s.estimation.prediction import Prediction, Sensitivity, Theta, predict, sensitivities
from r2s.estimation.problem import Problem, motion_alone
from r2s.scenarios.scenario import Scenario

Predicted = list[tuple[Prediction, Sensitivity]]  # of each recording
Derive = Callable[[Problems, Theta, float | None], Predicted]  # as `derivatives_at`
REMEMBERED = 128_000_000  # bytes of derivatives: a lift on 33 x 33 vertices takes 9 MB

# compiled once in a process for all recordings of as many frames and knots, on a mesh
predicted = compile_once(predict)
_sensitivities = compile_once(sensitivities)
_loss_from = compile_once(gauss_newton.loss_from)
_normal_from = compile_once(gauss_newton.normal_from)
prior_weight = eqx.filter_jit(gauss_newton.prior_weight)
_losses = eqx.filter_jit(eqx.filter_vmap(gauss_newton.loss_at, in_axes=(None, 0)))
_normals = eqx.filter_jit(eqx.filter_vmap(gauss_newton.normal_at, in_axes=(None, 0, 0, None)))


def derivatives_at(problems: Problems, theta: Theta, width: float | None = None) -> Predicted:
    """What each recording would show at a theta, and its derivative.

    `width`: as in `r2s.estimation.prediction.sensitivities`.
    """
    return thread_map(lambda pair: _sensitivities(*pair, width), _places(problems, theta))


def prepare(problems: Problems, width: float | None = None, *, derivatives: bool = True) -> None:
    """Compile what `derivatives_at`, or else `predictions_at`, will run; from any thread."""
    theta = jnp.zeros(gauss_newton.theta_length(problems), float)
    for pair in _places(problems, theta):
        if derivatives:
            _sensitivities.prepare(*pair, width)
        else:
            predicted.prepare(*pair)


def remembering() -> Derive:
    """`derivatives_at` of some problems and their beginnings, which knows where it was lately.

    A descent comes back to where it was whenever a stage, a search, or the standard errors begin.
    What was found there of more frames serves fewer, too.
    """
    known: list[_Known] = []  # the latest place last
    lock = threading.Lock()

    def derive(problems: Problems, theta: Theta, width: float | None = None) -> Predicted:
        return thread_map(lambda pair: one(*pair, width), _places(problems, theta))

    def one(problem: Problem, theta: Array, width: float | None):
        frames = problem.scenario.num_frames if problem.wanted is None else int(problem.wanted)
        place = np.asarray(theta)
        with lock:
            found = next((k for k in known if k.is_of(problem.scenario, place, width)), None)
        if found is None or found.frames < frames:
            derivatives = _sensitivities(problem, theta, width)
            found = _Known(problem.scenario, place, width, frames, derivatives)
        with lock:
            known[:] = [k for k in known if not k.is_of(problem.scenario, place, width)]
            known.append(found)
            while len(known) > 1 and sum(each.bytes for each in known) > REMEMBERED:
                del known[0]
        return found.derivatives

    return derive


class _Known(NamedTuple):
    """Derivatives of a scenario over some frames, at a place theta."""

    scenario: Scenario
    theta: np.ndarray
    width: float | None
    frames: int
    derivatives: tuple[Prediction, Sensitivity]

    def is_of(self, scenario: Scenario, theta: np.ndarray, width: float | None) -> bool:
        """Whether they are of this very scenario, at this place by this width."""
        is_alike = self.scenario is scenario and self.width == width
        return is_alike and np.array_equal(self.theta, theta)

    @property
    def bytes(self) -> int:
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self.derivatives))


def predictions_at(problems: Problems, theta: Theta) -> list[Prediction]:
    """What each recording would show at a theta."""
    return thread_map(lambda pair: predicted(*pair), _places(problems, theta))


def loss_from(problems: Problems, seen: Sequence[Prediction], scale: Array | float = 0.0) -> float:
    """The robust loss [m^2] of what is predicted of each recording; for `scale` [m] see
    `r2s.metrics.losses.robust`."""
    return float(_loss_from(problems, list(seen), None, jnp.asarray(scale, float)))


def normal_at(
    problems: Problems,
    theta: Theta,
    scale: Array,
    width: float | None = None,
    derive: Derive = derivatives_at,
) -> Normal:
    """`r2s.estimation.gauss_newton.normal_at`, by derivatives that `derive` gives."""
    return normal_from(problems, theta, derive(problems, theta, width), scale)


def normal_from(
    problems: Problems,
    theta: Theta,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
    scale: Array,
) -> Normal:
    """`r2s.estimation.gauss_newton.normal_from`."""
    return _normal_from(problems, theta, list(predicted), scale)


def losses_at(
    problems: Problems, thetas: Float[Array, "start theta"], progress: Progress | None = None
) -> np.ndarray:
    """The losses [m^2] of many thetas, simulated together; on a CPU side by side, since it gains
    nothing by simulating together."""
    if jax.default_backend() != "cpu":
        return np.asarray(_losses(problems, thetas))

    def loss(theta: Theta) -> float:
        return loss_from(problems, predictions_at(problems, theta))

    def done(number: int) -> None:
        tell(progress, f"coarse search {number} of {len(thetas)}")

    tell(progress, "compiling the motion")
    return np.array(thread_map(loss, thetas, done))


def normals_at(
    problems: Problems,
    thetas: list,
    scales: list,
    width: float | None,
    derive: Derive = derivatives_at,
) -> list[Normal]:
    """The normal equations at many thetas; see `losses_at` and `normal_at`.

    Together in numbers that are powers of two, so that few sizes are compiled.
    """
    if jax.default_backend() == "cpu" or len(thetas) == 1:
        pairs = zip(thetas, scales, strict=True)
        return thread_map(lambda pair: normal_at(problems, *pair, width, derive), pairs)
    more = 2 ** math.ceil(math.log2(len(thetas))) - len(thetas)
    filled = (jnp.stack([*parts, *[parts[-1]] * more]) for parts in (thetas, scales))
    found = _normals(problems, *filled, width)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(thetas))]


def _places(problems: Problems, theta: Theta) -> list[tuple[Problem, Array]]:
    """Of each recording what moves, and its own part of theta."""
    indices = (jnp.asarray(theta_indices(problems, i)) for i in range(len(problems)))
    pairs = zip(problems, indices, strict=True)
    return [(motion_alone(problem), theta[index]) for problem, index in pairs]
