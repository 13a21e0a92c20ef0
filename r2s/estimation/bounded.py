"""Steps of least loss that stay within a fabric's ranges.

Where a bound holds a parameter, the others go as far as they gain with it held. A step without
bounds, cut off at them, would leave them where they belong beside a value that cannot be reached.
"""

import numpy as np
from jaxtyping import Float
from scipy import optimize

from r2s.estimation.gauss_newton import MARGIN, Descent, Problems, prior_terms, theta_length
from r2s.estimation.prediction import Theta

ROUNDING = 1e-12  # of the largest curvature: less is none
AT_BOUND = 1e-6  # of a range: nearer than that, in single precision, is at it

Vector = Float[np.ndarray, " theta"]
Matrix = Float[np.ndarray, "theta theta"]


def room(problems: Problems, theta: Theta) -> tuple[Vector, Vector]:
    """How far each parameter may go down, at most 0, and up: a fabric's to its bounds, nuisances
    without end."""
    is_fabric = np.arange(theta_length(problems)) < problems[0].space.dim
    at = np.asarray(theta, np.float64)
    down, up = MARGIN - at, 1 - MARGIN - at
    down, up = np.where(down < -AT_BOUND, down, 0.0), np.where(up > AT_BOUND, up, 0.0)
    return np.where(is_fabric, down, -np.inf), np.where(is_fabric, up, np.inf)


def only_held(limits: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """`room` whose bounds hold but what stands at them: of a step that says how wrong a number is,
    and not where to go."""
    down, up = limits
    return np.where(down < 0, -np.inf, 0.0), np.where(up > 0, np.inf, 0.0)


def bounded_step(gradient: Vector, matrix: Matrix, limits: tuple[Vector, Vector]) -> Vector:
    """The step x within limits, see `room`, of least gradient x + x matrix x / 2.

    Not a number where these are. The matrix is a sum of squares, but for rounding.
    """
    if not (np.isfinite(gradient).all() and np.isfinite(matrix).all()):
        return np.full(len(gradient), np.nan)
    sizes, axes = np.linalg.eigh(np.asarray(matrix, np.float64))
    roots = np.sqrt(np.maximum(np.abs(sizes), ROUNDING * np.abs(sizes).max()))
    right = -axes.T @ np.asarray(gradient, np.float64) / roots
    return optimize.lsq_linear(roots[:, None] * axes.T, right, limits, method="bvls").x


def held_back(problems: Problems, end: Descent, prior: float) -> Vector:
    """How much farther the end of a descent would go had its fabric no bounds: zeros where it
    stands at none.

    - `prior`: its weight, see `r2s.estimation.gauss_newton.prior_weight`.
    """
    off, precision = (np.asarray(part, np.float64) for part in prior_terms(problems, end.theta))
    gradient = np.asarray(end.normal.gradient, np.float64) + prior * precision @ off
    matrix = np.asarray(end.normal.matrix, np.float64) + prior * precision
    within = bounded_step(gradient, matrix, only_held(room(problems, end.theta)))
    free = np.full(len(gradient), np.inf)
    return bounded_step(gradient, matrix, (-free, free)) - within
