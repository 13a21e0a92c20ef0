"""Gauss-Newton on nearest-point distances, with forward sensitivities: the default of r2s.

The loss is the reverse of DIFFCLOUD's (from recording to simulated surface, so that a partial view
does not attract hidden parts), robust against outliers. With few parameters forward mode gives the
normal equations, and with them step and covariance, for about the cost of one gradient.

Recordings of one fabric are weighted by their frames and `Problem.weight`. For `theta` see
`r2s.estimation.prediction`.
"""

import math
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s._util.threads import thread_map
from r2s.compilation import compile_once
from r2s.estimation.least_squares import (
    Damping,
    at_bound,
    bounded_step,
    damped,
    newton_step,
    proposed,
)
from r2s.estimation.method import Progress, tell
from r2s.estimation.normal_equations import (
    MEMORY,
    PATCHES,
    Loss,
    Scale,
    loss_of,
    normal_equations_of,
)
from r2s.estimation.prediction import (
    Derive,
    Predicted,
    Prediction,
    Theta,
    derivatives_at,
    predict,
    predictions_at,
    sensitivities,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problems

MARGIN = 1e-3  # of the unit cube, so that a start at its edge can move
LONGEST_STEP = 0.2  # of a parameter's range
FINEST = 1e-5  # [m]: the least error of a recording
AT_BOUND = 1e-6  # of a range, within which a parameter in single precision is at a bound


class Normal(eqx.Module):
    """The loss at a theta, and its normal equations there, without the prior.

    - `loss`: robust mean, [m^2]; infinite when the run diverged.
    - `spread`: robust standard deviation of the distances, [m], of recordings by their weights.
    - `widest`: the same, of the recording where it is largest.
    - `gradient`, `matrix`: derivative of the loss in theta, and its Gauss-Newton matrix, [m^2].
    - `scatter`: covariance of the gradient, [m^4], see the function `scatter`.
    """

    loss: Float[Array, "*start"]
    spread: Float[Array, "*start"]
    widest: Float[Array, "*start"]
    gradient: Float[Array, "*start theta"]
    matrix: Float[Array, "*start theta theta"]
    scatter: Float[Array, "*start theta theta"]


class Descent(eqx.Module):
    """The state of a Levenberg-Marquardt descent, with the normal equations at its theta.

    - `damping`, `growth`: see `r2s.estimation.least_squares.Damping`.
    - `scale`: of the robust loss, [m], see `r2s.metrics.losses.robust`; 0: no outliers.
    - `stage`: see `max_iterations` of `r2s.estimation.method.Budget`.
    """

    theta: Float[Array, "*start theta"]
    normal: Normal
    damping: Float[Array, "*start"]
    growth: Float[Array, "*start"]
    scale: Float[Array, "*start"]
    stage: Int[Array, "*start"]


def recording_weights(problems: Problems) -> list[Float[Array, ""]]:
    """Weight of each recording in the loss: its share of all frames, times its `weight`."""
    weights = (jnp.ones((), float) if p.weight is None else p.weight for p in problems)
    frames = [len(p.frames) * weight for p, weight in zip(problems, weights, strict=True)]
    return [count / sum(frames) for count in frames]


def loss_at(
    problems: Problems, theta: Theta, loss: Loss | None = None, scale: Scale = 0.0
) -> Float[Array, ""]:
    """The loss [m^2] at a theta; infinite when a run diverged.

    - `loss`: of one recording; None: the robust one, of a `scale` [m].
    """
    predictions = [predict(p, theta[theta_indices(problems, i)]) for i, p in enumerate(problems)]
    return _loss_from(problems, predictions, loss, scale)


def _loss_from(
    problems: Problems, predictions: Sequence[Prediction], loss: Loss | None, scale: Scale
) -> Float[Array, ""]:
    total, weights = jnp.zeros((), float), recording_weights(problems)
    for problem, share, prediction in zip(problems, weights, predictions, strict=True):
        value = loss_of(problem, prediction, scale) if loss is None else loss(problem, prediction)
        total += share * jnp.where(prediction.ok, value, jnp.inf)
    return total


def normal_at(
    problems: Problems, theta: Theta, scale: Scale = 0.0, width: float | None = None
) -> Normal:
    """Loss, gradient and Gauss-Newton matrix at a theta.

    - `scale`: of the robust loss [m]. `width`: see `r2s.estimation.prediction.sensitivities`.
    """
    parts = (theta[theta_indices(problems, i)] for i in range(len(problems)))
    predicted = [sensitivities(p, own, width) for p, own in zip(problems, parts, strict=True)]
    return _normal_from(problems, theta, predicted, scale)


def _normal_from(problems: Problems, theta: Theta, predicted: Predicted, scale: Scale) -> Normal:
    losses, spreads, scores, matrices, noise = [], [], [], [], []
    weights, size = recording_weights(problems), theta_length(problems)
    for which, (share, (prediction, slope)) in enumerate(zip(weights, predicted, strict=True)):
        index = theta_indices(problems, which)
        own = normal_equations_of(problems[which], prediction, slope, scale)
        losses.append(share * jnp.where(prediction.ok, own.loss, jnp.inf))
        spreads.append(own.spread)
        zeros = jnp.zeros((len(own.scores), size, size), theta.dtype)
        scores.append(zeros[:, 0].at[:, index].set(share * own.scores))
        matrices.append(zeros.at[:, index[:, None], index].set(share * own.matrices))
        noise.append(share * own.noise)
    spread = jnp.sqrt(jnp.stack(weights) @ jnp.stack(spreads) ** 2)
    score, matrix = jnp.concatenate(scores), jnp.concatenate(matrices)
    least = least_weight(problems, spread)
    _, precision = prior_terms(problems, theta)
    return Normal(
        jnp.sum(jnp.stack(losses)),
        spread,
        jnp.max(jnp.stack(spreads)),
        jnp.sum(score, axis=0),
        jnp.sum(matrix, axis=0),
        scatter(score, matrix, jnp.concatenate(noise), precision, least),
    )


def scatter(
    scores: Float[Array, "cluster theta"],
    matrices: Float[Array, "cluster theta theta"],
    noise: Float[Array, " cluster"],
    precision: Float[Array, "theta theta"],
    weight: Float[Array, ""] | float,
) -> Float[Array, "theta theta"]:
    """Covariance of a gradient that is a sum over clusters with independent errors.

    Each score is that of a fit without its cluster: the sandwich estimator is the jackknife then
    (CR3 of Bell and McCaffrey 2002). Without a cluster the fit is one standard deviation of the
    prior away at most: where one cluster alone determines a direction, rounding would decide. In no
    direction is the covariance less than for residuals with independent errors, of a variance of
    `noise` times the cluster's matrix: less would be the chance of few clusters.

    - `precision`, `weight` [m^2]: of the prior.
    """
    whole = jnp.sum(matrices, axis=0) + weight * precision
    root, inverse = _roots(whole)
    # a cluster that alone determines a direction would leave nothing but rounding
    share = 1 - 16 * jnp.finfo(scores.dtype).eps

    def without(cluster):
        matrix, score = cluster
        parts, directions = jnp.linalg.eigh(inverse.T @ matrix @ inverse)
        left = 1 - share * jnp.clip(parts, 0, 1)
        return inverse @ (directions @ (directions.T @ (inverse.T @ score) / left))

    # one by one: batches of LAPACK in two programs at once wait for each other for ever
    away = jax.lax.map(without, (matrices, scores))
    alone = away @ root @ root.T
    squares = jnp.einsum("cu,uv,cv->c", away, precision, away)
    alone = alone / jnp.sqrt(jnp.maximum(squares, 1))[:, None]
    return _larger(alone.T @ alone, jnp.einsum("c,cuv->uv", noise, matrices), whole)


def _larger(one: Array, other: Array, metric: Array) -> Float[Array, "theta theta"]:
    """The larger of two positive matrices in each direction in which a metric separates them."""
    root, inverse = _roots(metric)
    apart, directions = jnp.linalg.eigh(inverse.T @ (one - other) @ inverse)
    absolute = (directions * jnp.abs(apart)[None]) @ directions.T
    return (one + other + root @ absolute @ root.T) / 2


def _roots(matrix: Float[Array, "theta theta"]) -> tuple[Array, Array]:
    """R and the inverse of its transpose, of a positive matrix R R^T, up to rounding."""
    sizes, axes = jnp.linalg.eigh(matrix)
    lengths = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(sizes.dtype).eps * sizes[-1]))
    return axes * lengths[None], axes / lengths[None]


def prior_terms(problems: Problems, theta: Theta) -> tuple[Theta, Float[Array, "theta theta"]]:
    """Difference of theta from its prior mean, and the precision of the prior: that of the fabric's
    space, and 1 for nuisance parameters."""
    dim, rest = problems[0].space.dim, theta_length(problems) - problems[0].space.dim
    mean, of_fabric = problems[0].space.prior()
    expected = jnp.concatenate([mean, jnp.zeros(rest, float)])
    precision = jnp.eye(dim + rest, dtype=float).at[:dim, :dim].set(of_fabric)
    return theta - expected, precision


@eqx.filter_jit
def prior_weight(problems: Problems, normal: Normal) -> Float[Array, ""]:
    """Weight [m^2] of the prior beside the loss: the likelihood is exp(-loss / weight).

    The gradient scatters like weight times the matrix then (magnitude adjustment of a composite
    likelihood, Pauli, Racugno and Ventura 2011). At most, as if all points of a cluster were one:
    few clusters of a rough loss may scatter by far more, and the prior would dominate.
    """
    _, precision = prior_terms(problems, jnp.zeros(theta_length(problems), float))
    least = least_weight(problems, normal.spread)
    inverse = jnp.linalg.inv(normal.matrix + least * precision)
    ratio = jnp.trace(inverse @ normal.scatter) / jnp.trace(inverse @ normal.matrix)
    most = MEMORY * least_weight(problems, jnp.sqrt(2 * normal.loss))
    return jnp.clip(ratio, jnp.finfo(ratio.dtype).tiny, jnp.maximum(most, least))


def least_weight(problems: Problems, spread: Float[Array, ""]) -> Float[Array, ""]:
    """Least weight [m^2] of the prior: as if all points of a patch and frame were one."""
    frames = sum(len(problem.frames) for problem in problems)
    return jnp.maximum(spread, FINEST) ** 2 / (frames * PATCHES**2)


@eqx.filter_jit
def objective(problems: Problems, theta: Theta, loss, prior) -> Float[Array, ""]:
    """Loss and prior [m^2] at a theta."""
    off, precision = prior_terms(problems, theta)
    return loss + prior * (off @ precision @ off) / 2


def _equations(problems: Problems, descent: Descent, prior):
    """Gradient and matrix with the prior, and the bounds of theta."""
    off, precision = prior_terms(problems, descent.theta)
    gradient = descent.normal.gradient + prior * precision @ off
    matrix = descent.normal.matrix + prior * precision
    bounded = jnp.arange(len(descent.theta)) < problems[0].space.dim
    low, high = jnp.where(bounded, MARGIN, -jnp.inf), jnp.where(bounded, 1 - MARGIN, jnp.inf)
    return gradient, matrix, low, high


@eqx.filter_jit
def remaining(problems: Problems, descent: Descent, prior) -> Float[Array, ""]:
    """Gain [m^2] predicted for the next Gauss-Newton step of the parameters not at a bound."""
    gradient, matrix, low, high = _equations(problems, descent, prior)
    fixed = at_bound(descent.theta, gradient, low, high)
    return -jnp.where(fixed, 0, gradient) @ newton_step(gradient, matrix, fixed) / 2


@eqx.filter_jit
def propose(problems: Problems, descent: Descent, prior) -> Theta:
    """The next trial: a damped Gauss-Newton step, within the unit cube."""
    gradient, matrix, low, high = _equations(problems, descent, prior)
    longest = jnp.where(jnp.isfinite(low), LONGEST_STEP, jnp.inf)
    damping = Damping(descent.damping, descent.growth)
    return proposed(descent.theta, gradient, matrix, damping, low, high, longest)


def is_finite(normal: Normal) -> Bool[Array, ""]:
    """Whether the loss and all its derivatives are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(normal)]))


@eqx.filter_jit
def accept(problems: Problems, descent: Descent, trial: Theta, tried: Normal, prior) -> Descent:
    """The descent after a trial: moved if that lowers the objective and all derivatives are finite,
    else damped more."""
    new = objective(problems, trial, tried.loss, prior)
    old = objective(problems, descent.theta, descent.normal.loss, prior)
    better = (new < old) & is_finite(tried)
    damping = damped(Damping(descent.damping, descent.growth), better)
    return Descent(
        jnp.where(better, trial, descent.theta),
        jax.tree.map(partial(jnp.where, better), tried, descent.normal),
        damping.value,
        damping.growth,
        descent.scale,
        descent.stage,
    )


Limits = tuple[Float[np.ndarray, " theta"], Float[np.ndarray, " theta"]]


def room(problems: Problems, theta: Theta) -> Limits:
    """The largest steps of each parameter down, at most 0, and up: a fabric's to its bounds,
    nuisance parameters without limit."""
    is_fabric = np.arange(theta_length(problems)) < problems[0].space.dim
    at = np.asarray(theta, np.float64)
    down, up = MARGIN - at, 1 - MARGIN - at
    down, up = np.where(down < -AT_BOUND, down, 0.0), np.where(up > AT_BOUND, up, 0.0)
    return np.where(is_fabric, down, -np.inf), np.where(is_fabric, up, np.inf)


def only_held(limits: Limits) -> Limits:
    """`room` in which only parameters at a bound are limited: for a step that is an error, not a
    move."""
    down, up = limits
    return np.where(down < 0, -np.inf, 0.0), np.where(up > 0, np.inf, 0.0)


def held_back(problems: Problems, end: Descent, prior: float) -> Float[np.ndarray, " theta"]:
    """How much farther the end of a descent would be without bounds; zero if it is at none.

    - `prior`: its weight, see `prior_weight`.
    """
    off, precision = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    gradient = np.asarray(end.normal.gradient, np.float64) + prior * precision @ off
    matrix = np.asarray(end.normal.matrix, np.float64) + prior * precision
    within = bounded_step(gradient, matrix, only_held(room(problems, end.theta)))
    free = np.full(len(gradient), np.inf)
    return bounded_step(gradient, matrix, (-free, free)) - within


_compiled_loss = compile_once(_loss_from)
normal_from = compile_once(_normal_from)  # of predictions at a theta
_losses = eqx.filter_jit(eqx.filter_vmap(loss_at, in_axes=(None, 0)))
_normals = eqx.filter_jit(eqx.filter_vmap(normal_at, in_axes=(None, 0, 0, None)))


def loss_from(
    problems: Problems, predictions: Sequence[Prediction], scale: Array | float = 0.0
) -> float:
    """The robust loss [m^2] of a prediction of each recording, see `loss_at`."""
    return float(_compiled_loss(problems, list(predictions), None, jnp.asarray(scale, float)))


def losses_at(
    problems: Problems, thetas: Float[Array, "start theta"], progress: Progress | None = None
) -> np.ndarray:
    """The losses [m^2] at many thetas: in one batch, or, on a CPU, on its threads."""
    if jax.default_backend() != "cpu":
        return np.asarray(_losses(problems, thetas))

    def done(number: int) -> None:
        tell(progress, f"coarse search {number} of {len(thetas)}")

    tell(progress, "compiling the motion")
    return np.array(
        thread_map(lambda at: loss_from(problems, predictions_at(problems, at)), thetas, done)
    )


def normals_at(
    problems: Problems,
    thetas: list,
    scales: list,
    width: float | None = None,
    derive: Derive = derivatives_at,
) -> list[Normal]:
    """The normal equations at many thetas: in batches, or, on a CPU, on its threads.

    The sizes of batches are powers of two, so that few are compiled.
    """

    if jax.default_backend() == "cpu" or len(thetas) == 1:
        return thread_map(
            lambda pair: normal_from(problems, pair[0], derive(problems, pair[0], width), pair[1]),
            zip(thetas, scales, strict=True),
        )
    more = 2 ** math.ceil(math.log2(len(thetas))) - len(thetas)
    filled = (jnp.stack([*parts, *[parts[-1]] * more]) for parts in (thetas, scales))
    normals = _normals(problems, *filled, width)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], normals) for i in range(len(thetas))]
