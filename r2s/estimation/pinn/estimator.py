"""The physics-informed network as an estimator: stiffness from markers and force of stretchings.

A network is trained on each pull (`r2s.estimation.pinn.training`). From it the motions in
equilibrium are computed (`r2s.estimation.pinn.weak_form`), and the stiffness whose motions fit
markers and force best, with its covariance.

The fit takes damped Gauss-Newton steps within the ranges, and estimates the noise of markers and
force with the stiffness. The loop is our own, since solvers of optimistix begin each motion anew
and cannot estimate the noise: from three pulls `optimistix.LevenbergMarquardt` arrives at the same
place with six times the CPU seconds.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.least_squares import Damping, at_bound, damped, newton_step, proposed
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull, stacked
from r2s.estimation.pinn.training import NOISE, Recipe, train
from r2s.estimation.pinn.weak_form import DEGREES, Motion, equilibrium, prepare
from r2s.estimation.standard_errors import to_small_strain
from r2s.materials.parameters import ParameterSpace, stiffens

# near the clamps the tension carries some of the weight, which the model gives to the table
FRICTION_ERROR = 0.1  # [-]
# between a mesh of 33 x 33 vertices and the continuum, over four noise seeds of five fabrics
STIFFNESS_ERROR, COUPLING_ERROR = 0.006, 0.004  # relative; [-]
MODEL_ERRORS = {"friction": FRICTION_ERROR, "coupling": COUPLING_ERROR, "nu": COUPLING_ERROR}
MAX_STEP = 0.1  # of Gauss-Newton, of a range
BOUNDS = 1e-3, 1 - 1e-3  # of places in the ranges
FLAT_PRIOR = 12.0  # one over the variance of a uniform distribution on 0..1
MAX_STEPS = 60
SMALL = 0.05  # of the standard errors: the Gauss-Newton step at which it has converged
LEAST_NOISE = (1e-7, 1e-5)  # of markers [m], and of the force over its greatest [-]


class Fit(NamedTuple):
    """The best fit of markers and force.

    - `place`: in the space's unit cube. - `covariance`: of that place.
    - `noise`: rms differences that are left, of markers [m] and of the force over its greatest [-].
    - `places`, `losses`: of every step; the losses are mean squares of the markers' rest [m^2].
    - `converged`: whether the next Gauss-Newton step is small, or no place near by fits better.
    - `law`: covariance by stiffness that changes with the stretch, see `_law_error`; zero for
      spaces of yarns that stiffen.
    """

    place: Float[np.ndarray, " dim"]
    covariance: Float[np.ndarray, "dim dim"]
    noise: tuple[float, float]
    places: Float[np.ndarray, "step dim"]
    losses: Float[np.ndarray, " step"]
    converged: bool
    law: Float[np.ndarray, "dim dim"]


def estimate(
    pulls: Sequence[Pull],
    space: ParameterSpace,
    recipe: Recipe,
    *,
    progress: Callable[[int, float], None] | None = None,
    checkpoint: Path | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of one or several pulls.

    The standard errors come from the noise, from the change of the estimate with the number of
    virtual displacements, from what the model leaves out, and from what stiffness changes between
    half the stretch and all of it (they are those of stiffness at small strain). A parameter that
    the pulls do not determine has the standard error of its range. Without a force the nuisance
    "stiffness scale" says that the scale is not identifiable; ratios of stiffness may be.

    - `recipe`: of the training.
    - `progress`: called with the number of each chunk of training and its loss [m^2].
    - `checkpoint`: a file from which a killed training continues.

    Raises `ValueError` for pulls that do not go together, `RuntimeError` when the training diverges
    or no motion is in equilibrium.
    """
    began = time.perf_counter()
    trained = train(
        space, stacked(list(pulls)), recipe, report=progress, checkpoint=checkpoint, key=key
    )
    networks = [
        jax.tree.map(lambda leaf, i=i: leaf[i], trained.model.networks) for i in range(len(pulls))
    ]
    best = fit(space, networks, pulls, trained.places[-1], NOISE, DEGREES)
    fewer = DEGREES[0] - 1, DEGREES[1] - 1
    change = fit(space, networks, pulls, best.place, best.noise, fewer).place - best.place
    errors = [
        STIFFNESS_ERROR if r.unit == "N/m" else MODEL_ERRORS.get(r.name, 0.0) for r in space.ranges
    ]
    model = np.diag([(error / r.width) ** 2 for error, r in zip(errors, space.ranges, strict=True)])
    covariance = best.covariance + np.outer(change, change) + model + best.law
    words = f"{len(pulls)} pull{'s' if len(pulls) > 1 else ''}"
    has_force = pulls[0].force is not None
    if not has_force:
        words += ", no force: the scale of stiffness is not identifiable"
    words += "" if best.converged else ", not converged"
    deviations = np.sqrt(np.diag(covariance))
    places = np.concatenate([trained.places, best.places, best.place[None]])
    history = np.asarray(jax.vmap(space.values)(jnp.asarray(places, float)))
    return Estimate(
        approach=f"pinn ({words})",
        fabric=space(jnp.asarray(best.place, float)),
        ranges=space.ranges,
        values=history[-1],
        standard_errors=np.array([bound.width for bound in space.ranges]) * deviations,
        correlation=covariance / np.outer(deviations, deviations),
        nuisances=_nuisances(space, history[-1], covariance, best.noise, has_force),
        loss=float(best.losses[-1]),
        losses=np.concatenate([trained.losses * NOISE[0] ** 2, best.losses])[:, None],
        history=history[:-1, None],
        seconds=time.perf_counter() - began,
        converged=best.converged,
    )


def _nuisances(
    space: ParameterSpace, values: np.ndarray, covariance: np.ndarray, noise, has_force: bool
) -> tuple[Nuisance, ...]:
    """The noise of markers and force, and the geometric mean of the stiffnesses."""
    nuisances = [Nuisance("marker noise", "m", noise[0], np.nan)]
    if has_force:
        nuisances.append(Nuisance("force noise", "-", noise[1], np.nan))
    scale = np.array([bound.width if bound.unit == "N/m" else 0.0 for bound in space.ranges])
    if scale.any():
        weights = scale / np.count_nonzero(scale)
        mean = float(np.exp(np.log(values[scale > 0]).mean()))
        spread = float(np.sqrt(weights @ covariance @ weights))  # relative, since log
        nuisances.append(Nuisance("stiffness scale", "N/m", mean, spread * mean))
    return tuple(nuisances)


def fit(
    space: ParameterSpace,
    networks: Sequence[Network],
    pulls: Sequence[Pull],
    place: Float[np.ndarray, " dim"],
    noise: tuple[float, float],
    degrees: tuple[int, int] = DEGREES,
    steps: int = MAX_STEPS,
) -> Fit:
    """The place in the parameter space whose motions in equilibrium fit markers and force best.

    The ranges count as a flat prior. A force that was not measured does not count.

    - `networks`: trained, one for each of the `pulls`.
    - `place`: to begin with, in the space's unit cube.
    - `noise`: of the markers [m], and of the force over its greatest [-], to begin with.
    - `degrees`: of the virtual displacements, along and across the pull. - `steps`: at most.

    Raises `RuntimeError` when no motion is in equilibrium.
    """
    ready = [prepare(n, p, degrees) for n, p in zip(networks, pulls, strict=True)]
    given, starts = zip(*ready, strict=True)

    def motions_at(place: Array, starts) -> list[Motion]:
        parts = zip(pulls, given, starts, strict=True)
        return [equilibrium(space, place, *part) for part in parts]

    def equations(motions: Sequence[Motion], at: Array) -> tuple[float, np.ndarray, np.ndarray]:
        return _equations(motions, pulls, noise, np.asarray(at, np.float64) - 0.5)

    low, high = (jnp.full(space.dim, bound, float) for bound in BOUNDS)
    at = jnp.clip(jnp.asarray(place, float), low, high)
    motions, damping = motions_at(at, starts), Damping.initial(at.dtype)
    if not any(motion.is_balanced.any() for motion in motions):
        raise RuntimeError("no pull has a motion in equilibrium")
    places, losses, converged = [], [], False
    for _ in range(steps):
        places.append(np.asarray(at, np.float64))
        losses.append(_rms_residuals(motions, pulls)[0] ** 2)
        loss, *normal = equations(motions, at)
        gradient, matrix = (jnp.asarray(part, float) for part in normal)
        step = np.abs(newton_step(gradient, matrix, at_bound(at, gradient, low, high)))
        small = SMALL * np.sqrt(np.diag(np.linalg.inv(normal[1])))
        is_near = not _unbalanced(motions) and bool(np.all(step <= MAX_STEP))
        converged = is_near and bool(np.all(step < small))
        if converged:
            break
        trial = proposed(at, gradient, matrix, damping, low, high, MAX_STEP)
        changed = motions_at(trial, [motion.coefficients for motion in motions])
        trial_loss = equations(changed, trial)[0]
        is_better = (_unbalanced(changed), trial_loss) < (_unbalanced(motions), loss)
        damping = damped(damping, jnp.asarray(is_better))
        if is_better:
            at, motions = trial, changed
        elif np.all(np.abs(trial - at) < small):
            converged = is_near  # the tolerance of the motions decides what is better
            break
        if is_near:  # the residuals of a longer step are not noise
            left = _rms_residuals(motions, pulls)
            noise = max(left[0], LEAST_NOISE[0]), max(left[1], LEAST_NOISE[1])
    covariance = np.linalg.inv(equations(motions, at)[2])
    law = np.zeros_like(covariance)
    if not stiffens(space.ranges):
        law = _law_error(motions, pulls, noise, space.dim)
    history = np.array(places), np.array(losses)
    return Fit(np.asarray(at, np.float64), covariance, noise, *history, converged, law)


def _unbalanced(motions: Sequence[Motion]) -> int:
    """Number of frames that are not in equilibrium."""
    return sum(int((~motion.is_balanced).sum()) for motion in motions)


def _equations(
    motions: Sequence[Motion],
    pulls: Sequence[Pull],
    noise: tuple[float, float],
    off: Float[np.ndarray, " dim"],
    until: float = 1.0,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the sum of squares of all pulls and the prior, its gradient and Gauss-Newton matrix.

    Frames count that are in equilibrium.

    - `off`: place less the mean of the prior.
    - `until`: share of the greatest stretch, up to which frames count.
    """
    loss, gradient = FLAT_PRIOR * off @ off / 2, FLAT_PRIOR * off
    matrix = FLAT_PRIOR * np.eye(len(off))
    for motion, pull in zip(motions, pulls, strict=True):
        span = np.asarray(pull.far.value - pull.near.value, np.float64)
        stretch = np.linalg.norm(span - span[0], axis=1)
        counts = np.asarray(motion.is_balanced) & (stretch <= until * stretch.max())
        markers, force = _residuals(motion, pull)
        rows = [(markers / noise[0], np.asarray(motion.markers_by_place) / noise[0])]
        if pull.force is not None:
            scale = noise[1] * _greatest(pull)
            rows.append((force / noise[1], np.asarray(motion.force_by_place) / scale))
        for value, slope in rows:
            value, slope = value[counts].ravel(), slope[counts].reshape(-1, len(off))
            slope = slope.astype(np.float64)
            loss += value @ value / 2
            gradient = gradient + slope.T @ value
            matrix = matrix + slope.T @ slope
    return float(loss), gradient, matrix


def _residuals(motion: Motion, pull: Pull) -> tuple[np.ndarray, np.ndarray]:
    """Differences of markers [m], and of the force over the greatest [-], by frame."""
    markers, force = (np.asarray(part, np.float64) for part in (motion.markers, motion.force))
    measured = 0.0 if pull.force is None else np.asarray(pull.force, np.float64)
    return markers, (force - measured) / _greatest(pull)


def _rms_residuals(motions: Sequence[Motion], pulls: Sequence[Pull]) -> tuple[float, float]:
    """The rms of `_residuals` of all pulls, in the frames that are in equilibrium."""
    parts = []
    for motion, pull in zip(motions, pulls, strict=True):
        counts = np.asarray(motion.is_balanced)
        parts.append([part[counts].ravel() for part in _residuals(motion, pull)])
    together = (np.concatenate(part) for part in zip(*parts, strict=True))
    marker, force = (float(np.sqrt(np.mean(part**2))) for part in together)
    return marker, force


def _greatest(pull: Pull) -> float:
    """The greatest force of a pull [N]; 1 without one."""
    return 1.0 if pull.force is None else float(jnp.max(jnp.abs(pull.force)))


def _law_error(
    motions: Sequence[Motion], pulls: Sequence[Pull], noise: tuple[float, float], dim: int
) -> Float[np.ndarray, "dim dim"]:
    """Covariance of the place at small strain, for what stiffness changes with the stretch: by the
    frames up to half of the greatest, see `r2s.estimation.standard_errors`."""
    steps, variances = [], []
    for until in (0.5, 1.0):
        _, gradient, matrix = _equations(motions, pulls, noise, np.zeros(dim), until)
        steps.append(-np.linalg.solve(matrix, gradient))
        variances.append(np.diag(np.linalg.inv(matrix)))
    (half, whole), (half_variance, variance) = steps, variances
    off = to_small_strain(half - whole, half_variance - variance)
    return np.outer(off, off)
