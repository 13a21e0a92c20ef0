"""Wrinkles are zero or more, and limited: what that makes of a symmetric matrix.

A `Vector` is a symmetric matrix (11, 22, sqrt(2) 12), of one sample or of all side by side, in
units of the wrinkles' onset, in which the edges are rounded.
"""

from collections.abc import Callable

import jax.numpy as jnp

from r2s.mesh.vectors import Matrix, Number, Vector

ROOT = 2**0.5
Principal = tuple[Number, Number, Number, Number]  # see `principal_of`


def principal_of(matrix: Vector) -> Principal:
    """Mean and radius of the principal values; cosine and sine of twice the first one's angle."""
    mean, half, shear = (matrix[0] + matrix[1]) / 2, (matrix[0] - matrix[1]) / 2, matrix[2] / ROOT
    squared = half**2 + shear**2
    has_axes = squared > jnp.finfo(squared.dtype).tiny
    length = jnp.sqrt(jnp.where(has_axes, squared, 1))
    radius = jnp.where(has_axes, length, 0)
    return mean, radius, jnp.where(has_axes, half / length, 1), shear / length


def _between(value: Number, most: Number) -> Number:
    """The value between none and most; parabolas from 1 before these to 1 beyond."""
    low = jnp.where(value < 1, jnp.clip(value + 1, 0, 2) ** 2 / 4, value)
    return jnp.where(value > most - 1, most - jnp.clip(most + 1 - value, 0, 2) ** 2 / 4, low)


def _between_slope(value: Number, most: Number) -> Number:
    return jnp.clip((value + 1) / 2, 0, 1) * jnp.clip((most + 1 - value) / 2, 0, 1)


def limits(value: Number, most: Number) -> Number:
    """The convex function between none and most whose proximal map is `_between`."""
    left = most - value
    return _edge(value) + jnp.where(left < 1, _edge(left) + 1 / 6, 0)


def held_back(principal: Principal, most: Number) -> Number:
    """By how much the principal values of `limited` fall short of those before, near the most."""
    mean, radius, _, _ = principal
    parts = (
        jnp.where(v > most - 1, v - _between(v, most), 0) for v in (mean + radius, mean - radius)
    )
    return sum(parts, start=jnp.zeros_like(mean))


def _edge(inside: Number) -> Number:
    inside = jnp.clip(inside, 0, 1)
    root = jnp.sqrt(jnp.where(inside > 0, inside, 1))
    return jnp.where(inside > 0, 4 / 3 * inside * root - inside - inside**2 / 2, 0)


def of_principal(function: Callable[[Number], Number], principal: Principal) -> Vector:
    """The matrix with a function of its principal values."""
    mean, radius, cosine, sine = principal
    high, low = function(mean + radius), function(mean - radius)
    middle, half = (high + low) / 2, (high - low) / 2
    return middle + half * cosine, middle - half * cosine, ROOT * half * sine


def limited(principal: Principal, most: Number) -> Vector:
    """The nearest matrix whose principal values are between none and most, its edges rounded."""
    return of_principal(lambda value: _between(value, most), principal)


def limited_slope(principal: Principal, most: Number) -> Matrix:
    """The derivative of `limited` in the matrix."""
    mean, radius, cosine, sine = principal
    high, low = mean + radius, mean - radius
    along, across = (_between_slope(value, most) for value in (high, low))
    # differences of almost equal values are lost in rounding
    is_round = radius <= jnp.finfo(radius.dtype).eps ** (1 / 3) * (1 + abs(mean))
    quotient = (_between(high, most) - _between(low, most)) / jnp.where(is_round, 1, 2 * radius)
    turned = jnp.where(is_round, (along + across) / 2, quotient)
    parts = (
        (along, ((1 + cosine) / 2, (1 - cosine) / 2, sine / ROOT)),
        (across, ((1 - cosine) / 2, (1 + cosine) / 2, -sine / ROOT)),
        (turned, (-sine / ROOT, sine / ROOT, cosine)),
    )

    def entry(i, j):
        terms = [weight * axis[i] * axis[j] for weight, axis in parts]
        return terms[0] + terms[1] + terms[2]

    a, b, c, d, e, f = (entry(*at) for at in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return (a, b, c), (b, d, e), (c, e, f)
