"""The heavy elastica: how a strip that is clamped at one end bends under its own weight."""

import numpy as np
from scipy.integrate import solve_bvp


def elastica(number: float) -> tuple[float, float]:
    """How far the tip of a strip of length 1 reaches, and how far it hangs down.

    `number` is weight per area times length^3 over bending stiffness. The moment at s carries the
    weight beyond, so that the angle below the horizontal obeys theta'' = -number (1 - s) cos theta.
    """

    def slope(s, y):
        return np.stack([y[1], -number * (1 - s) * np.cos(y[0])])

    def ends(clamped, free):
        return np.array([clamped[0], free[1]])

    s = np.linspace(0, 1, 201)
    guess = np.stack([np.pi / 2 * (1 - np.exp(-number * s / 3)), 0 * s])
    solution = solve_bvp(slope, ends, s, guess, tol=1e-8, max_nodes=20000)
    assert solution.success
    s = np.linspace(0, 1, 2001)
    angle = solution.sol(s)[0]
    return np.trapezoid(np.cos(angle), s), np.trapezoid(np.sin(angle), s)
