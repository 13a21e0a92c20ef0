"""Standard errors of an estimate: what the end of its descent says, and the places around it.

`covariance` is the sandwich estimator with the prior, plus the mean squared Gauss-Newton step from
nearby places, so that a rough or unconverged fit reports larger errors.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.compiled import Derive, derivatives_at, normal_from, normals_at, prior_weight
from r2s.estimation.gauss_newton import MARGIN, Descent, Normal, Problems, prior_terms
from r2s.estimation.method import Budget
from r2s.estimation.prediction import Theta

FARTHEST = 2.0  # times the median distance, beyond which a step is shortened

Neighbours = list[tuple[Theta, Normal]]  # places around the end, with their normal equations


def covariance(
    problems: Problems,
    end: Descent,
    prior,
    apart: Float[Array, "place theta"],
    is_truth: bool = False,
) -> Float[Array, "theta theta"]:
    """Covariance of theta at the end of one descent.

    The sandwich estimator with the prior, plus the mean square of where Gauss-Newton steps from the
    end and from its neighbours lead. Where the loss is smooth the steps lead back to the end; where
    it is rough each leads elsewhere, as descents do. A step that leads farther than `FARTHEST`
    times the median, in standard errors, is shortened to that.

    - `prior`: its weight, see `gauss_newton.prior_weight`.
    - `apart`: the `steps_apart` of the neighbours, on this mesh or another.
    - `is_truth`: the end is the true theta. Then its own step is noise, and the distances of the
      others count from where it leads.

    Where derivatives are not finite only the prior is known.
    """
    own = step_end(problems, end.theta, end.normal, prior) - end.theta
    own = jnp.where(is_truth, 0, own)
    off = own[None] + jnp.concatenate([jnp.zeros_like(apart, shape=(1, len(own))), apart])
    sandwich, root = sandwich_of(problems, end, prior)
    far = jnp.linalg.norm(jnp.linalg.solve(root, off.T), axis=0)
    limit = FARTHEST * jnp.median(far)
    off = off * jnp.where(far > limit, limit / far, 1)[:, None]
    found = sandwich + off.T @ off / len(off)
    _, precision = prior_terms(problems, end.theta)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, jnp.linalg.inv(precision))


def steps_apart(
    problems: Problems, end: Descent, prior, neighbours: Neighbours
) -> Float[Array, "place theta"]:
    """How far Gauss-Newton steps from neighbours lead from where that of the end does."""
    led = [step_end(problems, *place, prior) for place in [(end.theta, end.normal), *neighbours]]
    return jnp.stack(led)[1:] - led[0][None]


def sample_around(
    problems: Problems, end: Descent, prior, count: int, key: PRNGKeyArray
) -> Float[Array, "place theta"]:
    """Places one standard error away from the end of a descent, an even `count`, in opposite
    pairs."""
    sandwich, root = sandwich_of(problems, end, prior)
    signs = jax.random.rademacher(key, (count // 2, len(sandwich)), sandwich.dtype)
    places = end.theta[None] + jnp.concatenate([signs, -signs]) @ root.T
    bounded = jnp.arange(len(sandwich)) < problems[0].space.dim
    return jnp.where(bounded[None], jnp.clip(places, MARGIN, 1 - MARGIN), places)


def sandwich_of(problems: Problems, end: Descent, prior):
    """The covariance of an estimate, had it arrived and were the loss smooth, and its symmetric
    root, which rounding changes no more than it changes the covariance."""
    _, precision = prior_terms(problems, end.theta)
    inverse = jnp.linalg.inv(end.normal.matrix + prior * precision)
    sandwich = inverse @ (end.normal.scatter + prior**2 * precision) @ inverse
    deviation = jnp.sqrt(jnp.diag(sandwich))
    squares, axes = jnp.linalg.eigh(sandwich / jnp.outer(deviation, deviation))
    least = len(squares) * jnp.finfo(squares.dtype).eps
    root = (axes * jnp.sqrt(jnp.maximum(squares, least))[None]) @ axes.T
    return sandwich, deviation[:, None] * root


def step_end(problems: Problems, theta: Theta, normal: Normal, prior) -> Theta:
    """Where the Gauss-Newton step from a place leads, regardless of bounds.

    A run that diverged, or whose derivatives did, takes no step.
    """
    off, precision = prior_terms(problems, theta)
    matrix = normal.matrix + prior * precision
    step = jnp.linalg.solve(matrix, normal.gradient + prior * precision @ off)
    finite = jnp.isfinite(normal.loss) & jnp.all(jnp.isfinite(step))
    return theta - jnp.where(finite, step, 0)


_covariance = eqx.filter_jit(covariance)
_steps_apart = eqx.filter_jit(steps_apart)
_sample_around = eqx.filter_jit(sample_around)


def covariance_at(
    problems: Problems,
    budget: Budget,
    end: Descent,
    key: PRNGKeyArray,
    is_truth: bool = False,
    tried_on: Problems | None = None,
    derive: Derive = derivatives_at,
) -> Float[np.ndarray, "theta theta"]:
    """Covariance of theta at the end of a descent, see `covariance`.

    All frames count in it, as they did in the descent. Where the motion is rough, steps from places
    around the end lead far apart, and the covariance grows by that; no limit decides between two
    answers, which rounding could take for each other.

    - `tried_on`: the same recordings on a mesh on which the places around the end are tried, one
      standard error of that mesh away.
    - `derive`: what gives derivatives at the end, of which it may know some.
    """
    there, here = tried_on or problems, end
    if there is not problems:
        normal = normal_from(there, end.theta, derive(there, end.theta, budget.width), end.scale)
        here = dataclasses.replace(end, normal=normal)
    apart = _apart(there, here, budget, key)
    prior = prior_weight(problems, end.normal)
    return np.asarray(_covariance(problems, end, prior, apart, is_truth))


def _apart(
    problems: Problems, end: Descent, budget: Budget, key: PRNGKeyArray
) -> Float[Array, "place theta"]:
    """How far steps from places around the end of a descent lead from where its own leads."""
    if not budget.around:
        return jnp.zeros((0, len(end.theta)), float)
    prior = prior_weight(problems, end.normal)
    places = list(_sample_around(problems, end, prior, budget.around, key))
    normals = normals_at(problems, places, [end.scale] * len(places), budget.width)
    return _steps_apart(problems, end, prior, list(zip(places, normals, strict=True)))
