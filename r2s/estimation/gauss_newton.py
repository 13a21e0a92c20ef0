"""Gauss-Newton on nearest-point distances, with forward sensitivities: the default of r2s.

The loss is that of DIFFCLOUD turned round (recording to simulated surface, so that a partial view
does not pull on what it does not see), robust against outliers. The parameters are few, so the
derivative of the whole motion with respect to all of them costs about as much as one gradient, and
its normal equations give the step and the covariance at once.

Several recordings of one fabric count by their frames: `Joint` is a tuple of problems, its unknown
the fabric's place, what they share (`SHARED`), and what is each one's own (`OWN`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s.estimation import normal_equations
from r2s.estimation.prediction import Theta, predict, sensitivities
from r2s.estimation.problem import OWN, SHARED, Problem

Joint = tuple[Problem, ...]

MARGIN = 1e-3  # of the unit cube, so that a start at its edge can move
PRIOR_DEVIATION = 0.29  # of a uniform prior over the unit cube
DAMPINGS, GROWTH = (1e-5, 1e6), 3.0
LONGEST_STEP = 0.2  # of a parameter's range
FINEST = 1e-5  # [m]: no recording is better


class Normal(eqx.Module):
    """The loss at an unknown, and its normal equations there, without the prior.

    - `loss`: robust mean, [m^2]; infinite when the run diverged.
    - `spread`: robust standard deviation of the distances, [m].
    - `gradient`, `matrix`: of the loss in the unknown, [m^2].
    - `scatter`: covariance of the gradient, [m^4], from how it varies between clusters, see
      `scatter`.
    """

    loss: Float[Array, "*start"]
    spread: Float[Array, "*start"]
    gradient: Float[Array, "*start unknown"]
    matrix: Float[Array, "*start unknown unknown"]
    scatter: Float[Array, "*start unknown unknown"]


class Descent(eqx.Module):
    """A Levenberg-Marquardt descent.

    - `unknown`: see `r2s.estimation.prediction`.
    - `normal`: the normal equations there.
    - `damping`: Levenberg's, [-]; `growth`: its factor should the next step fail (Nielsen 1999).
    - `scale`: beyond which distances do not count, [m]; 0: all do, see
      `r2s.evaluation.losses.robust`.
    - `stage`: which of an estimate's, see `r2s.estimation.descent.Effort`.
    """

    unknown: Float[Array, "*start unknown"]
    normal: Normal
    damping: Float[Array, "*start"]
    growth: Float[Array, "*start"]
    scale: Float[Array, "*start"]
    stage: Int[Array, "*start"]


def size(problems: Joint) -> int:
    """Of the unknown of some recordings of one fabric."""
    return problems[0].space.dim + len(SHARED) + len(OWN) * len(problems)


def part_of(problems: Joint, which: int) -> np.ndarray:
    """Where in the joint unknown that of one recording is."""
    shared = problems[0].space.dim + len(SHARED)
    first = shared + len(OWN) * which
    return np.concatenate([np.arange(shared), np.arange(first, first + len(OWN))])


def shares(problems: Joint) -> list[float]:
    """Weights of the recordings: their frames among all."""
    frames = [len(problem.frames) for problem in problems]
    return [count / sum(frames) for count in frames]


def loss_at(
    problems: Joint,
    unknown: Theta,
    loss: normal_equations.Loss | None = None,
    scale: normal_equations.Scale = 0.0,
) -> Float[Array, ""]:
    """The robust loss [m^2] at an unknown, with the `scale` [m] of `r2s.evaluation.losses.robust`.

    Or another `loss`. Infinite when a run diverged.
    """
    total = jnp.zeros((), unknown.dtype)
    for which, (problem, share) in enumerate(zip(problems, shares(problems), strict=True)):
        seen = predict(problem, unknown[part_of(problems, which)])
        value = (
            normal_equations.loss_of(problem, seen, scale) if loss is None else loss(problem, seen)
        )
        total += share * jnp.where(seen.ok, value, jnp.inf)
    return total


def normal_at(
    problems: Joint,
    unknown: Theta,
    scale: normal_equations.Scale = 0.0,
    width: float | None = None,
) -> Normal:
    """Loss, gradient and Gauss-Newton matrix at an unknown.

    `scale` as of `r2s.evaluation.losses.robust`, `width` as of
    `r2s.estimation.prediction.sensitivities`.
    """
    losses, spreads, scores, matrices, noise = [], [], [], [], []
    for which, (problem, share) in enumerate(zip(problems, shares(problems), strict=True)):
        index = part_of(problems, which)
        seen, slope = sensitivities(problem, unknown[index], width)
        found = normal_equations.normal_equations_of(problem, seen, slope, scale)
        losses.append(share * jnp.where(seen.ok, found.loss, jnp.inf))
        spreads.append(share * found.spread**2)
        zeros = jnp.zeros((len(found.scores), size(problems), size(problems)), unknown.dtype)
        scores.append(zeros[:, 0].at[:, index].set(share * found.scores))
        matrices.append(zeros.at[:, index[:, None], index].set(share * found.matrices))
        noise.append(share * found.noise)
    spread = jnp.sqrt(jnp.sum(jnp.stack(spreads)))
    score, matrix = jnp.concatenate(scores), jnp.concatenate(matrices)
    least = jnp.diag(pull(problems, unknown)[1]) * least_weight(problems, spread)
    return Normal(
        jnp.sum(jnp.stack(losses)),
        spread,
        jnp.sum(score, axis=0),
        jnp.sum(matrix, axis=0),
        scatter(score, matrix, jnp.concatenate(noise), least),
    )


def scatter(
    scores: Float[Array, "cluster unknown"],
    matrices: Float[Array, "cluster unknown unknown"],
    noise: Float[Array, " cluster"],
    prior: Float[Array, "unknown unknown"],
) -> Float[Array, "unknown unknown"]:
    """Covariance of a gradient that is a sum over clusters which err independently.

    Each score is what it would be had its cluster not been fitted: with that the sandwich is the
    jackknife, which does not take few clusters for much evidence (CR3 of Bell and McCaffrey 2002).
    In no direction is it less than if all residuals erred independently, with a variance of `noise`
    times its matrix: where it is, that is the chance of few clusters.
    """
    whole = jnp.sum(matrices, axis=0) + prior
    # a cluster that alone tells something would leave nothing behind, but for rounding
    share = 1 - 16 * jnp.finfo(scores.dtype).eps
    left = jnp.eye(len(prior), dtype=scores.dtype)[None] - share * matrices @ jnp.linalg.inv(whole)
    alone = jax.vmap(jnp.linalg.solve)(left, scores)
    return _larger(alone.T @ alone, jnp.einsum("c,cuv->uv", noise, matrices), whole)


def _larger(one: Array, other: Array, metric: Array) -> Float[Array, "unknown unknown"]:
    """The larger of two positive matrices in each direction in which a metric tells them apart."""
    sizes, axes = jnp.linalg.eigh(metric)
    lengths = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(sizes.dtype).eps * sizes[-1]))
    root, inverse = axes * lengths[None], axes / lengths[None]
    apart, directions = jnp.linalg.eigh(inverse.T @ (one - other) @ inverse)
    absolute = (directions * jnp.abs(apart)[None]) @ directions.T
    return (one + other + root @ absolute @ root.T) / 2


def pull(problems: Joint, unknown: Theta) -> tuple[Theta, Theta]:
    """Difference from the unknown that the prior expects, and the inverse of its variance."""
    dim, rest = problems[0].space.dim, size(problems) - problems[0].space.dim
    expected = jnp.concatenate([jnp.full(dim, 0.5, float), jnp.zeros(rest, float)])
    spread = jnp.concatenate([jnp.full(dim, PRIOR_DEVIATION, float), jnp.ones(rest, float)])
    return unknown - expected, 1 / spread**2


def prior_weight(problems: Joint, normal: Normal) -> Float[Array, ""]:
    """Weight [m^2] of the prior at the best unknown: how much the loss scatters by chance.

    The likelihood is exp(-loss / weight) when the gradient scatters like weight times the matrix
    (magnitude adjustment of a composite likelihood, Pauli, Racugno and Ventura 2011).
    """
    _, precision = pull(problems, jnp.zeros(size(problems), float))
    least = least_weight(problems, normal.spread)
    inverse = jnp.linalg.inv(normal.matrix + least * jnp.diag(precision))
    ratio = jnp.trace(inverse @ normal.scatter) / jnp.trace(inverse @ normal.matrix)
    return jnp.maximum(ratio, jnp.finfo(ratio.dtype).tiny)


def least_weight(problems: Joint, spread: Float[Array, ""]) -> Float[Array, ""]:
    """What the prior weighs at least [m^2]: as if all points of a patch and frame were one."""
    frames = sum(len(problem.frames) for problem in problems)
    return jnp.maximum(spread, FINEST) ** 2 / (frames * normal_equations.PATCHES**2)


def objective(problems: Joint, unknown, loss, prior) -> Float[Array, ""]:
    """Loss and prior [m^2] at an unknown."""
    off, precision = pull(problems, unknown)
    return loss + prior * jnp.sum(off**2 * precision) / 2


def remaining(problems: Joint, descent: Descent, prior) -> Float[Array, ""]:
    """What the next Gauss-Newton step promises to gain [m^2], of the unknowns not at a bound."""
    gradient, matrix, stuck = _equations(problems, descent, prior)
    pinned = jnp.where(stuck[:, None] | stuck[None], jnp.diag(jnp.diag(matrix)), matrix)
    gradient = jnp.where(stuck, 0, gradient)
    return gradient @ jnp.linalg.solve(pinned, gradient) / 2


def _equations(problems: Joint, descent: Descent, prior):
    """Gradient and matrix with the prior, and which unknowns would leave the unit cube."""
    unknown = descent.unknown
    off, precision = pull(problems, unknown)
    gradient = descent.normal.gradient + prior * precision * off
    matrix = descent.normal.matrix + prior * jnp.diag(precision)
    bounded = jnp.arange(unknown.shape[0]) < problems[0].space.dim
    stuck = bounded & (unknown <= MARGIN) & (gradient > 0)
    stuck |= bounded & (unknown >= 1 - MARGIN) & (gradient < 0)
    return gradient, matrix, stuck


def propose(problems: Joint, descent: Descent, prior) -> Theta:
    """The next unknown to try: a damped Gauss-Newton step, within the unit cube.

    What runs into a bound stays there, and the other unknowns take the step alone.
    """
    unknown = descent.unknown
    bounded = jnp.arange(unknown.shape[0]) < problems[0].space.dim
    gradient, matrix, stuck = _equations(problems, descent, prior)
    damped = matrix + descent.damping * jnp.diag(jnp.diag(matrix))
    pinned = jnp.where(stuck[:, None] | stuck[None], jnp.diag(jnp.diag(damped)), damped)
    change = -jnp.linalg.solve(pinned, jnp.where(stuck, 0, gradient))
    longest = jnp.max(jnp.where(bounded, jnp.abs(change), 0))
    change = change / jnp.maximum(1, longest / LONGEST_STEP)
    inside = jnp.clip(unknown + change, MARGIN, 1 - MARGIN)
    return jnp.where(bounded, inside, unknown + change)


def accept(problems: Joint, descent: Descent, trial: Theta, tried: Normal, prior) -> Descent:
    """The descent after a trial: moved if that lowers the objective, else damped more."""
    new = objective(problems, trial, tried.loss, prior)
    old = objective(problems, descent.unknown, descent.normal.loss, prior)
    better = new < old
    take = lambda new, old: jnp.where(better, new, old)
    damping = jnp.where(better, descent.damping / 4, descent.damping * descent.growth)
    return Descent(
        take(trial, descent.unknown),
        jax.tree.map(take, tried, descent.normal),
        jnp.clip(damping, *DAMPINGS),
        jnp.where(better, GROWTH, 2 * descent.growth),
        descent.scale,
        descent.stage,
    )
