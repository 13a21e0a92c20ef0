"""Gauss-Newton on nearest-point distances, with forward sensitivities: the default of r2s.

The loss is that of DIFFCLOUD turned round (recording to simulated surface, so that a partial view
does not pull on what it does not see), robust against outliers. The parameters are few, so the
derivative of the whole motion with respect to all of them costs about as much as one gradient, and
its normal equations give the step and the covariance at once.

Several recordings of one fabric are weighed by their frames, and by how well each can be followed
(`Problem.weight`). Their joint parameter vector `theta` is the fabric's place in its space, the
nuisances that all recordings share (`SHARED`), and those of each recording (`OWN`).

The steps are those of `r2s.estimation.least_squares`; the normal equations are made here, by
clusters of residuals, which the standard errors need. (`optimistix.LevenbergMarquardt`, without
bounds and prior, came on a lift of 20 frames and 5 x 5 vertices from three starts to the same loss,
6.789e-6 m^2, with 26 sensitivities each, its limit, where this arrived after 21, 22 and 16.)
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.estimation import normal_equations
from r2s.estimation.least_squares import Damping, at_bound, damped, newton_step, proposed
from r2s.estimation.prediction import Prediction, Sensitivity, Theta, predict, sensitivities
from r2s.estimation.problem import OWN, SHARED, Problem

Problems = tuple[Problem, ...]

MARGIN = 1e-3  # of the unit cube, so that a start at its edge can move
LONGEST_STEP = 0.2  # of a parameter's range
FINEST = 1e-5  # [m]: no recording is better


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
    """A Levenberg-Marquardt descent.

    - `theta`: where it is, see `r2s.estimation.prediction`.
    - `normal`: the normal equations there.
    - `damping`: Levenberg's, [-].
    - `growth`: factor of the damping should the next step fail (Nielsen 1999).
    - `scale`: beyond which distances do not count, [m]; 0: all do, see
      `r2s.metrics.losses.robust`.
    - `stage`: its stage in an estimate, see `iterations` of `r2s.estimation.method.Budget`.
    """

    theta: Float[Array, "*start theta"]
    normal: Normal
    damping: Float[Array, "*start"]
    growth: Float[Array, "*start"]
    scale: Float[Array, "*start"]
    stage: Int[Array, "*start"]


def theta_length(problems: Problems) -> int:
    """Length of theta: fabric, nuisances shared by all recordings, nuisances of each."""
    return problems[0].space.dim + len(SHARED) + len(OWN) * len(problems)


def theta_indices(problems: Problems, which: int) -> np.ndarray:
    """Indices in theta of the parameters of one recording."""
    shared = problems[0].space.dim + len(SHARED)
    first = shared + len(OWN) * which
    return np.concatenate([np.arange(shared), np.arange(first, first + len(OWN))])


def recording_weights(problems: Problems) -> list[Float[Array, ""]]:
    """Weight of each recording: its share of all frames, each by the weight of its recording."""
    frames = [
        len(problem.frames) * (jnp.ones((), float) if problem.weight is None else problem.weight)
        for problem in problems
    ]
    return [count / sum(frames) for count in frames]


def loss_at(
    problems: Problems,
    theta: Theta,
    loss: normal_equations.Loss | None = None,
    scale: normal_equations.Scale = 0.0,
) -> Float[Array, ""]:
    """The loss [m^2] at a theta; infinite when a run diverged.

    - `loss`: of one recording; None: the robust one.
    - `scale`: of the robust loss [m], see `r2s.metrics.losses.robust`.
    """
    seen = [predict(each, theta[theta_indices(problems, i)]) for i, each in enumerate(problems)]
    return loss_from(problems, seen, loss, scale)


def loss_from(
    problems: Problems,
    seen: Sequence[Prediction],
    loss: normal_equations.Loss | None = None,
    scale: normal_equations.Scale = 0.0,
) -> Float[Array, ""]:
    """`loss_at` a theta from what it predicts of each recording."""
    total = jnp.zeros((), float)
    for problem, share, found in zip(problems, recording_weights(problems), seen, strict=True):
        value = (
            normal_equations.loss_of(problem, found, scale)
            if loss is None
            else loss(problem, found)
        )
        total += share * jnp.where(found.ok, value, jnp.inf)
    return total


def normal_at(
    problems: Problems,
    theta: Theta,
    scale: normal_equations.Scale = 0.0,
    width: float | None = None,
) -> Normal:
    """Loss, gradient and Gauss-Newton matrix at a theta.

    - `scale`: of the robust loss [m], see `r2s.metrics.losses.robust`.
    - `width`: over which slopes are taken, see `r2s.estimation.prediction.sensitivities`.
    """
    found = [
        sensitivities(each, theta[theta_indices(problems, i)], width)
        for i, each in enumerate(problems)
    ]
    return normal_from(problems, theta, found, scale)


def normal_from(
    problems: Problems,
    theta: Theta,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
    scale: normal_equations.Scale = 0.0,
) -> Normal:
    """`normal_at` a theta from what it predicts of each recording, and its derivative."""
    losses, spreads, scores, matrices, noise = [], [], [], [], []
    weights = recording_weights(problems)
    for which, (problem, share, (seen, slope)) in enumerate(
        zip(problems, weights, predicted, strict=True)
    ):
        index = theta_indices(problems, which)
        found = normal_equations.normal_equations_of(problem, seen, slope, scale)
        losses.append(share * jnp.where(seen.ok, found.loss, jnp.inf))
        spreads.append(found.spread)
        zeros = jnp.zeros(
            (len(found.scores), theta_length(problems), theta_length(problems)), theta.dtype
        )
        scores.append(zeros[:, 0].at[:, index].set(share * found.scores))
        matrices.append(zeros.at[:, index[:, None], index].set(share * found.matrices))
        noise.append(share * found.noise)
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
    """Covariance of a gradient that is a sum over clusters which err independently.

    Each score is corrected to what it would be had its cluster not been fitted. With that the
    sandwich estimator is the jackknife, which does not take few clusters for much evidence (CR3 of
    Bell and McCaffrey 2002). Without a cluster the fit is one standard deviation of the prior away
    at most: where a cluster alone tells a direction, and its loss is rough, it would be farther by
    what rounding leaves of the others. In no direction is the covariance less than if all residuals
    erred independently, with a variance of `noise` times the cluster's matrix: less would be the
    chance of few clusters.

    - `precision`, `weight` [m^2]: of the prior.
    """
    whole = jnp.sum(matrices, axis=0) + weight * precision
    root, inverse = _roots(whole)
    # a cluster that alone tells something would leave nothing behind, but for rounding
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
    """The larger of two positive matrices in each direction in which a metric tells them apart."""
    root, inverse = _roots(metric)
    apart, directions = jnp.linalg.eigh(inverse.T @ (one - other) @ inverse)
    absolute = (directions * jnp.abs(apart)[None]) @ directions.T
    return (one + other + root @ absolute @ root.T) / 2


def _roots(matrix: Float[Array, "theta theta"]) -> tuple[Array, Array]:
    """R and the inverse of its transpose, of a positive matrix R R^T, but for rounding."""
    sizes, axes = jnp.linalg.eigh(matrix)
    lengths = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(sizes.dtype).eps * sizes[-1]))
    return axes * lengths[None], axes / lengths[None]


def prior_terms(problems: Problems, theta: Theta) -> tuple[Theta, Float[Array, "theta theta"]]:
    """Difference of theta from the mean of its prior, and the precision of the prior: that of the
    fabric's space, and of nuisances in their standard deviations.
    """
    dim, rest = problems[0].space.dim, theta_length(problems) - problems[0].space.dim
    mean, of_fabric = problems[0].space.prior()
    expected = jnp.concatenate([mean, jnp.zeros(rest, float)])
    precision = jnp.eye(dim + rest, dtype=float).at[:dim, :dim].set(of_fabric)
    return theta - expected, precision


def prior_weight(problems: Problems, normal: Normal) -> Float[Array, ""]:
    """Weight [m^2] of the prior beside the loss: how much the loss scatters by chance.

    The likelihood is exp(-loss / weight) when the gradient scatters like weight times the matrix
    (magnitude adjustment of a composite likelihood, Pauli, Racugno and Ventura 2011). At most, as
    if all points of a cluster were one: few clusters of a rough loss may scatter by far more, and
    the prior would draw a fit to where its loss is several times as large.
    """
    _, precision = prior_terms(problems, jnp.zeros(theta_length(problems), float))
    least = least_weight(problems, normal.spread)
    inverse = jnp.linalg.inv(normal.matrix + least * precision)
    ratio = jnp.trace(inverse @ normal.scatter) / jnp.trace(inverse @ normal.matrix)
    most = normal_equations.MEMORY * least_weight(problems, jnp.sqrt(2 * normal.loss))
    return jnp.clip(ratio, jnp.finfo(ratio.dtype).tiny, jnp.maximum(most, least))


def least_weight(problems: Problems, spread: Float[Array, ""]) -> Float[Array, ""]:
    """Least weight [m^2] of the prior: as if all points of a patch and frame were one."""
    frames = sum(len(problem.frames) for problem in problems)
    return jnp.maximum(spread, FINEST) ** 2 / (frames * normal_equations.PATCHES**2)


def objective(problems: Problems, theta, loss, prior) -> Float[Array, ""]:
    """Loss and prior [m^2] at a theta."""
    off, precision = prior_terms(problems, theta)
    return loss + prior * (off @ precision @ off) / 2


def remaining(problems: Problems, descent: Descent, prior) -> Float[Array, ""]:
    """Gain [m^2] that the next Gauss-Newton step promises, by the parameters not at a bound."""
    gradient, matrix, low, high = _equations(problems, descent, prior)
    fixed = at_bound(descent.theta, gradient, low, high)
    return -jnp.where(fixed, 0, gradient) @ newton_step(gradient, matrix, fixed) / 2


def _equations(problems: Problems, descent: Descent, prior):
    """Gradient and matrix with the prior, and the bounds of theta."""
    off, precision = prior_terms(problems, descent.theta)
    gradient = descent.normal.gradient + prior * precision @ off
    matrix = descent.normal.matrix + prior * precision
    bounded = jnp.arange(len(descent.theta)) < problems[0].space.dim
    low, high = jnp.where(bounded, MARGIN, -jnp.inf), jnp.where(bounded, 1 - MARGIN, jnp.inf)
    return gradient, matrix, low, high


def propose(problems: Problems, descent: Descent, prior) -> Theta:
    """The next theta to try: a damped Gauss-Newton step, within the unit cube."""
    gradient, matrix, low, high = _equations(problems, descent, prior)
    longest = jnp.where(jnp.isfinite(low), LONGEST_STEP, jnp.inf)
    damping = Damping(descent.damping, descent.growth)
    return proposed(descent.theta, gradient, matrix, damping, low, high, longest)


def is_finite(normal: Normal) -> Bool[Array, ""]:
    """Whether the loss and all its derivatives are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(normal)]))


def accept(problems: Problems, descent: Descent, trial: Theta, tried: Normal, prior) -> Descent:
    """The descent after a trial: moved if that lowers the objective, else damped more.

    Where a derivative is not finite it does not move: it could neither go on from there, nor say
    how well its place is known.
    """
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
