"""Gauss-Newton on nearest-point distances, with forward sensitivities: r2s's default DIFFCLOUD.

The loss is that of DIFFCLOUD turned round (recording to simulated surface, so that a partial view
does not pull on what it does not see), robust against outliers. The parameters are few, so the
derivative of the whole motion with respect to all of them costs about as much as one gradient, and
its normal equations give the step and the covariance at once.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimators.base import Problem
from r2s.losses import robust, robust_weight, surface_residuals
from r2s.scenario import motion
from r2s.solver import Trajectory

MARGIN = 1e-3  # of the unit cube, so that a start at its edge can move
PRIOR_DEVIATION = 0.29  # of a uniform prior over the unit cube
LONGEST_STEP = 0.2  # of a parameter's range
PATCHES = 3  # along a side of the sheet: points of one patch in one frame err alike
SPAN = 1  # independent pieces of evidence in a frame, for the weight of the prior


class Normal(eqx.Module):
    """The loss at an unknown, and its normal equations there, of the clouds alone.

    - `loss`: robust mean, [m^2]; infinite when the run diverged.
    - `spread`: robust standard deviation of the distances, [m].
    - `gradient`, `matrix`: of the loss in the unknown, [m^2].
    - `scatter`: covariance of the gradient, [m^4], from how it varies between patches of the sheet
      and frames (a clustered sandwich): points of one patch and frame err alike.
    """

    loss: Float[Array, "*start"]
    spread: Float[Array, "*start"]
    gradient: Float[Array, "*start unknown"]
    matrix: Float[Array, "*start unknown unknown"]
    scatter: Float[Array, "*start unknown unknown"]


class Descent(eqx.Module):
    """A Levenberg-Marquardt descent.

    - `unknown`: a point of the family's unit cube, then the misalignment (x, y, z, turn) in units
      of its standard deviations.
    - `normal`: the normal equations there.
    - `damping`: Levenberg's, [-].
    """

    unknown: Float[Array, "*start unknown"]
    normal: Normal
    damping: Float[Array, "*start"]


def loss_at(problem: Problem, unknown: Float[Array, " unknown"]) -> Float[Array, ""]:
    """The robust loss [m^2] at an unknown; infinite when the run diverged."""
    place, shift = _split(problem, unknown)
    moved = motion(problem.scenario, problem.family(place))
    distance, *_ = _residuals(problem, _aligned(problem, moved.x, shift))
    return _loss(problem, moved, distance)


def normal_at(problem: Problem, unknown: Float[Array, " unknown"]) -> Normal:
    """Loss, gradient and Gauss-Newton matrix at an unknown."""
    place, shift = _split(problem, unknown)

    def move(place):
        moved = motion(problem.scenario, problem.family(place))
        return _aligned(problem, moved.x, shift), moved

    slope, moved = jax.jacfwd(move, has_aux=True)(place)  # (frame, vertex, axis, place)
    x = _aligned(problem, moved.x, shift)
    realign = lambda unknown: _aligned(problem, moved.x, _split(problem, unknown)[1])
    turn = jax.jacfwd(realign)(unknown)[..., problem.family.dim :]
    slope = jnp.concatenate([slope, turn], axis=-1)[jnp.array(problem.frames)]
    distance, direction, vertices, weights = _residuals(problem, x)
    picked = jax.vmap(lambda slope, vertices: slope[vertices])(slope, vertices)
    jacobian = -jnp.einsum("fpi,fpk,fpkiu->fpu", direction, weights, picked)
    weight = jnp.where(problem.mask, robust_weight(distance), 0) / jnp.sum(
        problem.mask, dtype=float
    )
    score = (weight * distance)[..., None] * jacobian
    seen = jnp.where(problem.mask, distance, jnp.nan)
    return Normal(
        loss=_loss(problem, moved, distance),
        spread=1.4826 * jnp.nanmedian(seen),  # the deviation of a normal one with that median
        gradient=jnp.sum(score, axis=(0, 1)),
        matrix=jnp.einsum("fp,fpu,fpv->uv", weight, jacobian, jacobian),
        scatter=_scatter(problem, score, vertices[..., 0]),
    )


def _scatter(problem: Problem, score: Float[Array, "frame point unknown"], vertex):
    """Sum over clusters of the outer product of their scores; a cluster is a patch in a frame."""
    rest = problem.scenario.scene.mesh.rest
    size = jnp.max(rest, axis=0, keepdims=True) * (1 + 1e-3)
    cell = jnp.floor(rest / size * PATCHES).astype(int)
    patch = (cell[:, 0] * PATCHES + cell[:, 1])[vertex]
    total = jax.vmap(lambda s, c: jax.ops.segment_sum(s, c, PATCHES**2))(score, patch)
    return jnp.einsum("fcu,fcv->uv", total, total)


def _prior(problem: Problem, unknown):
    """Difference from the expected unknown, and the inverse of its variance."""
    dim = problem.family.dim
    expected = jnp.concatenate([jnp.full(dim, 0.5, float), jnp.zeros(4, float)])
    spread = jnp.concatenate([jnp.full(dim, PRIOR_DEVIATION, float), jnp.ones(4, float)])
    return unknown - expected, 1 / spread**2


def _split(problem: Problem, unknown):
    """The point of the unit cube, and the misalignment in metres and radians."""
    shift, turn = problem.misalignment
    return unknown[: problem.family.dim], unknown[problem.family.dim :] * jnp.array(
        [shift, shift, shift, turn]
    )


def _aligned(problem: Problem, x: Float[Array, "frame vertex 3"], shift: Float[Array, " 4"]):
    """Positions [m] in the frame of the cameras: turned about the first handle, and shifted."""
    pivot = x[:, problem.scenario.scene.held[:1]]
    cosine, sine = jnp.cos(shift[3]), jnp.sin(shift[3])
    turn = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
    offset = x - pivot
    turned = jnp.concatenate([offset[..., :2] @ turn.T, offset[..., 2:]], axis=-1)
    return pivot + turned + shift[None, None, :3]


def _residuals(problem: Problem, x):
    faces = problem.scenario.scene.mesh.faces
    per_frame = jax.vmap(lambda points, mask, x: surface_residuals(points, mask, x, faces))
    return per_frame(problem.points, problem.mask, x[jnp.array(problem.frames)])


def _loss(problem: Problem, moved: Trajectory, distance) -> Float[Array, ""]:
    loss = jnp.sum(robust(distance)) / jnp.sum(problem.mask, dtype=float)
    return jnp.where(jnp.all(moved.ok), loss, jnp.inf)


def prior_weight(problem: Problem, spread: Float[Array, ""]) -> Float[Array, ""]:
    """Weight [m^2] of the prior, where the distances have this spread [m] at the best unknown.

    What no fabric explains is an error that the clouds of a frame share, so it counts once a frame.
    """
    return spread**2 / (SPAN * len(problem.frames))


def objective(problem: Problem, unknown, loss, prior) -> Float[Array, ""]:
    """Loss and prior [m^2] at an unknown."""
    pull, precision = _prior(problem, unknown)
    return loss + prior * jnp.sum(pull**2 * precision) / 2


def covariance(problem: Problem, descent: Descent, prior) -> Float[Array, "unknown unknown"]:
    """Of the unknown, at the end of one descent: the clustered sandwich, with the prior.

    To it comes the square of the Gauss-Newton step that would be next, so that a descent which has
    not arrived does not claim to know.
    """
    pull, precision = _prior(problem, descent.unknown)
    inverse = jnp.linalg.inv(descent.normal.matrix + prior * jnp.diag(precision))
    step = inverse @ (descent.normal.gradient + prior * precision * pull)
    spread = descent.normal.scatter + prior**2 * jnp.diag(precision)
    return inverse @ spread @ inverse + jnp.outer(step, step)


def propose(problem: Problem, descent: Descent, prior) -> Float[Array, " unknown"]:
    """The next unknown to try: a damped Gauss-Newton step, within the unit cube.

    What runs into a bound stays there, and the other unknowns take the step alone.
    """
    unknown = descent.unknown
    pull, precision = _prior(problem, unknown)
    gradient = descent.normal.gradient + prior * precision * pull
    matrix = descent.normal.matrix + prior * jnp.diag(precision)
    bounded = jnp.arange(unknown.shape[0]) < problem.family.dim
    damped = matrix + descent.damping * jnp.diag(jnp.diag(matrix))
    stuck = bounded & (unknown <= MARGIN) & (gradient > 0)
    stuck |= bounded & (unknown >= 1 - MARGIN) & (gradient < 0)
    pinned = jnp.where(stuck[:, None] | stuck[None], jnp.diag(jnp.diag(damped)), damped)
    change = -jnp.linalg.solve(pinned, jnp.where(stuck, 0, gradient))
    longest = jnp.max(jnp.where(bounded, jnp.abs(change), 0))
    change = change / jnp.maximum(1, longest / LONGEST_STEP)
    inside = jnp.clip(unknown + change, MARGIN, 1 - MARGIN)
    return jnp.where(bounded, inside, unknown + change)


def accept(
    problem: Problem, descent: Descent, trial: Float[Array, " unknown"], tried: Normal, prior
) -> Descent:
    """The descent after a trial: moved if that lowers the objective, else damped more."""
    new = objective(problem, trial, tried.loss, prior)
    old = objective(problem, descent.unknown, descent.normal.loss, prior)
    better = new < old
    take = lambda new, old: jnp.where(better, new, old)
    damping = jnp.where(better, descent.damping / 5, descent.damping * 5)
    return Descent(
        take(trial, descent.unknown),
        jax.tree.map(take, tried, descent.normal),
        jnp.clip(damping, 1e-6, 1e6),
    )
