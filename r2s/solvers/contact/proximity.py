"""Proximity: the closest points of two pieces of a surface, and when they meet in a motion.

A pair is four vertices: vertex-triangle (the vertex, then the triangle's corners) or edge-edge
(the two ends of one edge, then those of the other). Signed weights w that sum to zero put its
closest points together: sum_i w_i x_i is the vector from the second body's to the first's.

- vertex-triangle: w = (1, -b0, -b1, -b2), b the barycentric coordinates in the triangle,
- edge-edge: w = (1 - s, s, -(1 - t), -t).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

TOLERANCE = 0.01  # of the gap: how much too far apart an impact may be reported
DIP = 0.98  # of its distance: a pair within the gap that keeps this much does not approach
MAX_ADVANCES = 64

# The ways in which the closest points lie on the bodies' boundaries: a vertex, and a point of an
# edge. Way k has the weights start[k] + t along[k], t in [0, 1]. The starts are also the
# differences from each corner of the second body to each of the first.
_TRIANGLE_START = np.array([[1, 0, -1, 0], [1, -1, 0, 0], [1, 0, 0, -1], [1, 0, -1, 0]])
_TRIANGLE_ALONG = np.array([[0, 0, 1, -1], [0, 1, -1, 0], [0, -1, 0, 1], [0, 0, 1, -1]])
_EDGES_START = np.array([[1, 0, -1, 0], [0, 1, 0, -1], [0, 1, -1, 0], [1, 0, 0, -1]])
_EDGES_ALONG = np.array([[0, 0, 1, -1], [0, 0, -1, 1], [1, -1, 0, 0], [-1, 1, 0, 0]])
_TRIANGLE_SIGN = np.array([1, -1, -1, -1])
_EDGES_SIGN = np.array([1, 1, -1, -1])


def closest_weights(corners: Float[Array, "4 3"], is_edges: Bool[Array, ""]) -> Float[Array, " 4"]:
    """The weights of the closest points of a pair with its corners at positions [m].

    Where several are closest, as on parallel edges, they are one of them, and jump to another one
    as the pair turns. Values and derivatives are finite for bodies of any shape, also points.

    Only points on the boundaries are considered where the interior ones are ill-defined: when the
    sine of the angle between the two edges, or at the triangle's first corner, is below the square
    root of the precision, or (single precision) the bodies are smaller than 0.02 mm.
    """
    return _closest(corners, is_edges)[0]


def separation(corners: Float[Array, "4 3"], weights: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """The vector [m] from the second body's point to the first's, sum_i w_i x_i."""
    near = corners - corners[3:]  # changes nothing but the rounding, as the weights sum to zero
    return jnp.sum(weights[:, None] * near, axis=0)


def _closest(corners, is_edges):
    """The weights, and a vector along the line between the points, of any length but zero.

    Where the points are inside the bodies it is a normal of both, whose direction is also precise
    when they nearly touch.
    """
    start = _either(is_edges, _EDGES_START, _TRIANGLE_START, corners.dtype)
    along = _either(is_edges, _EDGES_ALONG, _TRIANGLE_ALONG, corners.dtype)
    offset, direction = _combine(start, corners), _combine(along, corners)
    at = jnp.clip(_ratio(-_dot(offset, direction), _dot(direction, direction)), 0, 1)[:, None]
    between = offset + at * direction
    nearest = jnp.argmin(_dot(between, between))
    interior, normal, is_inside = _interior(corners, is_edges)
    weights = jnp.where(is_inside, interior, (start + at * along)[nearest])
    between = separation(corners, weights)
    outward = jnp.where(_dot(normal, between) < 0, -normal, normal)
    return weights, jnp.where(is_inside, outward, between)


def time_of_impact(
    start: Float[Array, "4 3"],
    end: Float[Array, "4 3"],
    is_edges: Bool[Array, ""],
    gap: Float[Array, ""],
) -> Float[Array, ""]:
    """The first time in [0, 1] of a straight motion at which a pair comes closer than a gap [m].

    Infinity when it does not. The time is never late; where it is early, the pair is then within
    1 % of the gap (and 32 roundings of its size and motion) of it.

    A pair that starts within the gap (or 1 % of it) gets 0 when it approaches, which is that its
    distance falls by 2 % at some time, or when it ends there; infinity when it leaves without.

    Conservative advancement (Mirtich 1996; Li et al. 2021, "Codimensional IPC", section 5), here
    with a plane: the one across the line between the closest points separates the bodies until
    the first of their corners arrives, so time may advance to there. If `MAX_ADVANCES` were not
    enough (31 were, for each of a million pairs at random), it would return the time reached, which
    may be far too early, but is not late.
    """
    start, end = (corners - jnp.mean(corners, axis=0, keepdims=True) for corners in (start, end))
    motion = end - start
    size = jnp.maximum(jnp.max(jnp.abs(start)), jnp.max(jnp.abs(end)))
    rounding = 32 * jnp.finfo(start.dtype).eps * size

    def distance(corners):
        return _length(separation(corners, closest_weights(corners, is_edges)))

    distances = jax.vmap(distance)(jnp.stack([start, end]))
    starts_near, ends_near = distances <= gap * (1 + TOLERANCE) + rounding
    floor = jnp.where(starts_near, DIP * distances[0], gap)
    met = _advance(start, motion, is_edges, floor, TOLERANCE * floor + rounding)
    of_near = jnp.where(jnp.isfinite(met) | ends_near, 0.0, jnp.inf)
    return jnp.where(starts_near, of_near, met)


def _advance(start, motion, is_edges, floor, tolerance):
    """The time at which the distance reaches the floor [m], or infinity. Early by the tolerance."""

    def line(time):
        corners = start + time * motion
        weights, along = _closest(corners, is_edges)
        return along, (corners, separation(corners, weights))

    def advance(state):
        time, _, count = state
        along, change, (corners, between) = jax.jvp(line, (time,), (one,), has_aux=True)
        normal = _ratio(along, _length(along))
        turn = _ratio(change - _dot(normal, change) * normal, _length(along))
        apart = _apart(corners, is_edges), _apart(motion, is_edges)
        stays = _safe_time(*apart, normal, jnp.zeros_like(turn), floor + tolerance / 2)
        turns = _safe_time(*apart, normal, turn, floor + tolerance / 2)
        # farther round, its rounding would grow
        turns = jnp.minimum(turns, 4 / jnp.maximum(_length(turn), 1))
        later = time + jnp.maximum(stays, turns)
        # an advance of nothing: as close as rounding allows
        is_met = (_length(between) <= floor + tolerance) | (later <= time)
        return jnp.where(is_met, time, later), is_met, count + 1

    one = jnp.ones((), start.dtype)

    def is_open(state):
        return ~state[1] & (state[0] <= 1) & (state[2] < MAX_ADVANCES)

    initial = jnp.zeros((), start.dtype), jnp.zeros((), bool), jnp.zeros((), int)
    time, _, _ = jax.lax.while_loop(is_open, advance, initial)
    return jnp.where(time <= 1, time, jnp.inf)


def _safe_time(apart, motion, normal, turn, floor):
    """How long a plane that turns keeps the bodies the floor [m] apart.

    Until then (normal + t turn) . (apart + t motion) >= floor |normal + t turn| for the vectors
    from every corner of one body to those of the other, with |normal + t turn| <= 1 + t^2 turn^2/2.
    """
    normal, turn = normal[None, :], turn[None, :]
    clearance = _dot(normal, apart) - floor
    rate = _dot(normal, motion) + _dot(turn, apart)
    curvature = _dot(turn, motion) - floor / 2 * _dot(turn, turn)
    discriminant = rate**2 - 4 * clearance * curvature
    slope = jnp.sqrt(jnp.maximum(discriminant, 0)) - rate
    is_crossed = (discriminant >= 0) & (slope > 0)
    time = jnp.where(is_crossed, 2 * clearance / jnp.where(is_crossed, slope, 1), jnp.inf)
    return jnp.maximum(jnp.min(time), 0)


def _interior(corners, is_edges):
    """The weights of points inside both bodies, the common normal, and whether they are inside."""
    a, b, c, d = corners
    first = jnp.where(is_edges, b - a, c - b)
    second = jnp.where(is_edges, d - c, d - b)
    offset = jnp.where(is_edges, c - a, a - b)
    normal = jnp.cross(first, second)
    square, precision = _dot(normal, normal), jnp.finfo(corners.dtype).eps
    is_thin = square <= precision * _dot(first, first) * _dot(second, second)
    is_thin |= ~_is_regular(square)
    # offset = u first + v second + some normal
    u = _ratio(_dot(jnp.cross(offset, second), normal), square)
    v = _ratio(_dot(jnp.cross(first, offset), normal), square)
    edges = jnp.stack([1 - u, u, -1 - v, v])
    triangle = jnp.stack([jnp.ones_like(u), u + v - 1, -u, -v])
    weights = jnp.where(is_edges, edges, triangle)
    sign = _either(is_edges, _EDGES_SIGN, _TRIANGLE_SIGN, corners.dtype)
    return weights, normal, jnp.all(sign * weights >= 0) & ~is_thin


def _length(vector):
    return jnp.sqrt(_dot(vector, vector))


def _apart(corners, is_edges):
    """From every corner of the second body to those of the first."""
    return _combine(_either(is_edges, _EDGES_START, _TRIANGLE_START, corners.dtype), corners)


def _either(is_edges, edges, triangle, dtype):
    return jnp.where(is_edges, jnp.asarray(edges, dtype), jnp.asarray(triangle, dtype))


def _dot(left, right):
    # not `@`, which on a GPU may round to fewer digits
    return jnp.sum(left * right, axis=-1)


def _combine(weights, corners):
    """Each row of weights' sum of the corners."""
    return jnp.sum(weights[:, :, None] * corners[None, :, :], axis=1)


def _ratio(numerator, denominator):
    """The ratio, or 0 where its derivative may overflow."""
    is_regular = _is_regular(denominator)
    return jnp.where(is_regular, numerator / jnp.where(is_regular, denominator, 1), 0)


def _is_regular(denominator):
    return denominator > jnp.finfo(denominator.dtype).tiny ** 0.5
