"""How far a constant stiffness is from that at small strain, by what half of a pull tells.

Yarns stiffen as they stretch. A stiffness that is taken as constant comes out as a mean over the
pull, and no noise says so; but the first half of the pull alone leads elsewhere.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.compilation import compile_once
from r2s.estimation import normal_equations
from r2s.estimation.gauss_newton import (
    Descent,
    Problems,
    prior_terms,
    recording_weights,
    theta_indices,
    theta_length,
)
from r2s.estimation.prediction import Prediction, Sensitivity
from r2s.estimation.problem import Problem, seen_where
from r2s.materials.stiffening_space import stiffens

# from what stiffness changes between half a pull and all of it, to what it has from small strain:
# twice that where it grows with the stretch
TO_SMALL_STRAIN = 2.0

_equations = compile_once(normal_equations.normal_equations_of)


def to_small_strain(
    change: Float[np.ndarray, " place"], variance: Float[np.ndarray, " place"]
) -> Float[np.ndarray, " place"]:
    """How far places may be from those at small strain.

    - `change`: from where all of a pull leads to where its first half alone does.
    - `variance`: that this change has by noise: the difference of both places' (Hausman 1978).
    """
    squares = change**2 - np.maximum(variance, 0)
    return TO_SMALL_STRAIN * np.sign(change) * np.sqrt(np.maximum(squares, 0))


def law_error(
    problems: Problems,
    end: Descent,
    prior: Array,
    predicted: Sequence[tuple[Prediction, Sensitivity]],
) -> Float[np.ndarray, " theta"]:
    """How far theta may be from that at small strain, by one step of Gauss-Newton from its end;
    zero without a pull's force, and for spaces of yarns that stiffen.

    - `prior`: its weight, see `r2s.estimation.gauss_newton.prior_weight`.
    - `predicted`: at the end, with its derivative (`r2s.estimation.compiled.derivatives_at`).
    """
    if stiffens(problems[0].space.ranges) or all(problem.force is None for problem in problems):
        return np.zeros(theta_length(problems))
    halves = tuple(half_pulled(problem) for problem in problems)
    half, half_variance = _place(halves, problems, end, prior, predicted)
    whole, variance = _place(problems, problems, end, prior, predicted)
    off = to_small_strain(half - whole, half_variance - variance)
    return np.clip(np.where(np.isfinite(off), off, 1.0), -1, 1)


def half_pulled(problem: Problem) -> Problem:
    """The problem of a pull with nothing seen where its force is beyond the middle between least
    and greatest; any other as it is."""
    if problem.force is None:
        return problem
    force = jnp.linalg.norm(problem.force.values, axis=1)
    seen = problem.force.seen
    least = jnp.min(force, where=seen, initial=jnp.inf)
    greatest = jnp.max(force, where=seen, initial=0)
    early = force <= (least + greatest) / 2
    return seen_where(problem, lambda _: early)


def _place(
    seen: Problems, problems: Problems, end: Descent, prior: Array, predicted
) -> tuple[Float[np.ndarray, " theta"], Float[np.ndarray, " theta"]]:
    """Where what was `seen` leads from the end, and its variance by noise."""
    size = theta_length(problems)
    gradient, matrix, scatter = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
    for which, share in enumerate(np.asarray(recording_weights(problems), np.float64)):
        found = _equations(seen[which], *predicted[which], end.scale)
        scores, parts, noise = (
            np.asarray(each, np.float64) for each in (found.scores, found.matrices, found.noise)
        )
        index = theta_indices(problems, which)
        gradient[index] += share * scores.sum(axis=0)
        matrix[np.ix_(index, index)] += share * parts.sum(axis=0)
        scatter[np.ix_(index, index)] += share**2 * np.einsum("c,cuv->uv", noise, parts)
    off, known = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    least = float(prior) * known
    inverse = np.linalg.inv(matrix + least)
    variance = inverse @ (scatter + float(prior) * least) @ inverse
    return -inverse @ (gradient + least @ off), np.diag(variance)
