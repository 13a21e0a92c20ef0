"""Levenberg-Marquardt for networks: all residuals at once, with a dense Jacobian.

A network of some thousand weights learns a field to many more digits by Gauss and Newton's steps
than by a descent along gradients (Jnini et al. 2024), and the matrix of the last step is the
information on what it learned. Residuals come in rows: a row depends on all unknowns, but its
derivative costs no more than a row.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cho_factor, cho_solve

DAMPINGS, GROWTH = (1e-9, 1e9), 2.0  # of Levenberg's, times the mean of the matrix's diagonal
FIRST = 1e-3  # damping
SMALL = 1e-4  # of the sum of squares: a gain after which there is no other
RIDGE = 1e-9  # of the mean of the diagonal: what makes directions harmless that nothing depends on

Unknown = Float[Array, " unknown"]


class Term(eqx.Module):
    """Residuals of one kind.

    - `function`: of the unknowns, `about` and one row; gives a few residuals [-].
    - `about`: what all rows share. - `rows`: arrays with a leading axis of rows.
    - `together`: rows whose derivatives are taken at once.
    """

    function: Callable[..., Array] = eqx.field(static=True)
    about: Any
    rows: Any
    together: int = eqx.field(static=True, default=256)


class Fit(NamedTuple):
    """Where a descent arrived.

    - `unknown`. - `squares`: sum of squares before each step, and after the last.
    - `information`: J^T J there. - `damping`: Levenberg's. - `converged`: it gains no more.
    """

    unknown: Float[np.ndarray, " unknown"]
    squares: Float[np.ndarray, " step"]
    information: Float[np.ndarray, "unknown unknown"]
    damping: float
    converged: bool


@eqx.filter_jit
def residuals(terms: Sequence[Term], unknown: Unknown) -> Array:
    """All residuals [-], one term after the other."""

    def of(term: Term):
        each = lambda row: term.function(unknown, term.about, row)
        return jax.lax.map(each, term.rows, batch_size=term.together).ravel()

    return jnp.concatenate([of(term) for term in terms])


@eqx.filter_jit
def _linear(terms: Sequence[Term], unknown: Unknown) -> tuple[Array, Array]:
    """Residuals and their Jacobian (residual, unknown)."""

    def of(term: Term):
        def each(row):
            value = lambda unknown: (lambda r: (r, r))(term.function(unknown, term.about, row))
            slope, residual = jax.jacrev(value, has_aux=True)(unknown)
            return residual, slope

        residual, slope = jax.lax.map(each, term.rows, batch_size=term.together)
        return residual.ravel(), slope.reshape(-1, len(unknown))

    parts = [of(term) for term in terms]
    return tuple(jnp.concatenate(part) for part in zip(*parts, strict=True))  # pyright: ignore


def normal_equations(terms: Sequence[Term], unknown: Float[np.ndarray, " unknown"]):
    """Residuals, J^T J and J^T r, in double precision. Raises `RuntimeError` if not finite."""
    residual, jacobian = _linear(tuple(terms), jnp.asarray(unknown, float))
    residual, jacobian = (np.asarray(part, np.float64) for part in (residual, jacobian))
    matrix, right = jacobian.T @ jacobian, jacobian.T @ residual
    if not (np.isfinite(residual).all() and np.isfinite(matrix).all()):
        raise RuntimeError("the residuals of the network or their derivatives are not finite")
    return residual, matrix, right


def least_squares(
    terms: Sequence[Term],
    unknown: Float[np.ndarray, " unknown"],
    steps: int,
    *,
    inside: Callable[[np.ndarray], np.ndarray] = lambda unknown: unknown,
    damping: float = FIRST,
    report: Callable[[float, np.ndarray], None] | None = None,
) -> Fit:
    """The unknowns of the least sum of squares, after at most `steps` steps from `unknown`.

    `inside` brings unknowns back within their bounds. `damping` as it was at the end of an earlier
    fit. `report` is called after each step with the sum of squares and the unknowns. A step that
    raises the sum is not made. Raises `RuntimeError` when the residuals are not finite.
    """
    terms, growth, converged = tuple(terms), GROWTH, False
    residual, matrix, right = normal_equations(terms, unknown)
    squares = [float(residual @ residual)]
    for _ in range(steps):
        mean = np.trace(matrix) / len(matrix)
        damped = matrix + (damping + RIDGE) * mean * np.eye(len(matrix))
        after = _stepped(damped, right, unknown, inside)
        change = after - unknown
        expected = -2 * right @ change - change @ matrix @ change
        found = np.asarray(residuals(terms, jnp.asarray(after, float)), np.float64)
        gain = squares[-1] - float(found @ found)
        if not (np.isfinite(gain) and gain > 0):
            damping, growth = min(damping * growth, DAMPINGS[1]), 2 * growth
            squares.append(squares[-1])
            converged = damping >= DAMPINGS[1]
        else:
            ratio = min(gain / max(float(expected), gain / 2), 2.0)  # Nielsen 1999
            damping = max(damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), DAMPINGS[0])
            growth, unknown = GROWTH, after
            squares.append(squares[-1] - gain)
            _, matrix, right = normal_equations(terms, unknown)
            converged = gain < SMALL * squares[-1]
        if report is not None:
            report(squares[-1], unknown)
        if converged:
            break
    return Fit(unknown, np.array(squares), matrix, damping, converged)


def _stepped(matrix: np.ndarray, right: np.ndarray, unknown: np.ndarray, inside) -> np.ndarray:
    """The unknowns after Newton's step, along the bounds where it would leave them."""
    whole = unknown - cho_solve(cho_factor(matrix), right)
    after = inside(whole)
    free = after == whole
    if free.all():
        return after
    held = (after - unknown)[~free]
    rest = right[free] + matrix[np.ix_(free, ~free)] @ held
    after[free] = unknown[free] - cho_solve(cho_factor(matrix[np.ix_(free, free)]), rest)
    return inside(after)


def marginal(
    information: Float[np.ndarray, "unknown unknown"], number: int
) -> Float[np.ndarray, "last last"]:
    """The information on the last `number` unknowns when all others are unknown too."""
    of_others, mixed = information[:-number, :-number], information[:-number, -number:]
    mean = np.trace(of_others) / len(of_others)
    held = of_others + RIDGE * mean * np.eye(len(of_others))
    return information[-number:, -number:] - mixed.T @ cho_solve(cho_factor(held), mixed)
