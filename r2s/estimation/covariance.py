"""The covariance of an estimate: of its noise, and of how far places around its end lead apart."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import gauss_newton, standard_errors
from r2s.estimation.compiled import Derive, derivatives_at, normal_from, normals_at
from r2s.estimation.gauss_newton import Descent, Problems
from r2s.estimation.method import Budget

_weight = eqx.filter_jit(gauss_newton.prior_weight)
_covariance = eqx.filter_jit(standard_errors.covariance)
_steps_apart = eqx.filter_jit(standard_errors.steps_apart)
_sample_around = eqx.filter_jit(standard_errors.sample_around)


def covariance_at(
    problems: Problems,
    budget: Budget,
    end: Descent,
    key: PRNGKeyArray,
    is_truth: bool = False,
    tried_on: Problems | None = None,
    derive: Derive = derivatives_at,
) -> Float[np.ndarray, "theta theta"]:
    """Covariance of theta at the end of a descent, see `r2s.estimation.standard_errors`.

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
    prior = _weight(problems, end.normal)
    return np.asarray(_covariance(problems, end, prior, apart, is_truth))


def _apart(
    problems: Problems, end: Descent, budget: Budget, key: PRNGKeyArray
) -> Float[Array, "place theta"]:
    """How far steps from places around the end of a descent lead from where its own leads."""
    if not budget.around:
        return jnp.zeros((0, len(end.theta)), float)
    prior = _weight(problems, end.normal)
    places = list(_sample_around(problems, end, prior, budget.around, key))
    normals = normals_at(problems, places, [end.scale] * len(places), budget.width)
    return _steps_apart(problems, end, prior, list(zip(places, normals, strict=True)))
