"""The bending of a grid's plate: turns of its lines at the vertices, twists of its cells.

The same as `PlateElements.of_grid`: a vertex has the curvatures of its two turns, or of the nearest
ones at the border, and of the cell whose origin it is. All but the angles is linear in what it
depends on, so that forces follow from moments by its transpose.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.mesh.vectors import Vector, add, cross, dot, scale, subtract
from r2s.solvers.explicit.layout import Layout, part, parts

Parts = tuple[Vector, Vector, Vector]  # axis, left and right wing of a bend [m]


class Bent(NamedTuple):
    """A bend (`r2s.mesh.bends`).

    - `angle`, `rate`: [rad] and [rad/s].
    - `gradients`: derivatives of the angle in axis and wings, [rad/m].
    """

    angle: Array
    rate: Array
    gradients: Parts


def bend(vectors: Parts, rates: Parts, exists: Array) -> Bent:
    """Of axis and wings [m], and their rates [m/s]; anything where none `exists`."""
    axis, left, right = vectors
    axis_rate, left_rate, right_rate = rates
    first, second = cross(axis, left), cross(right, axis)
    squared = jnp.where(exists, dot(axis, axis), 1)
    length = jnp.sqrt(squared)
    angle = jnp.arctan2(-length * dot(first, right), jnp.where(exists, dot(first, second), 1))
    by_left = scale(-length / jnp.where(exists, dot(first, first), 1), first)
    by_right = scale(-length / jnp.where(exists, dot(second, second), 1), second)
    left_share, right_share = dot(left, axis) / squared, dot(right, axis) / squared
    by_axis = subtract(scale(-left_share, by_left), scale(right_share, by_right))
    rate = dot(by_left, left_rate) + dot(by_right, right_rate) + dot(by_axis, axis_rate)
    return Bent(angle, rate, (by_axis, by_left, by_right))


def bending_force(
    layout: Layout, laws: Any, x: Vector, v: Vector, corners: Any, rates: Any
) -> tuple[Any, Vector]:
    """Forces [N] of the twists on the corners of the cells, and of the turns on the vertices."""
    turned, twisted = (
        once(partial(_turns, layout), x, v),
        once(partial(_twists, layout), corners, rates),
    )
    bent = (*turned, *twisted)
    curvature, to_angles = jax.vjp(partial(_curvature, layout), [b.angle for b in bent])
    rate = _curvature(layout, [b.rate for b in bent])
    stress = laws.bending.damped(curvature, rate, laws.damping)
    moments = to_angles(scale(layout.areas(stress[0]), stress))[0]
    strengths = [
        tuple(scale(-moment, gradient) for gradient in b.gradients)
        for moment, b in zip(moments, bent, strict=True)
    ]
    _, to_corners = jax.vjp(_twist_parts, corners)
    _, to_vertices = jax.vjp(partial(_turn_parts, layout), x)
    return to_corners(tuple(strengths[2:]))[0], layout.inner(to_vertices(tuple(strengths[:2]))[0])


def _turns(layout: Layout, x: Vector, v: Vector) -> tuple[Bent, Bent]:
    """Of the lines along warp and along weft, from a line before the first vertex on."""
    vectors, rates = _turn_parts(layout, x), _turn_parts(layout, v)
    warp, weft = (bend(vectors[a], rates[a], _turn_exists(layout, a, x[0])) for a in (0, 1))
    return warp, weft


def _twists(layout: Layout, corners: Any, rates: Any) -> tuple[Bent, Bent]:
    """Of all cells, between their sides along the warp and along the weft."""
    exists = layout.is_cell(corners[0][0])
    both = zip(_twist_parts(corners), _twist_parts(rates), strict=True)
    warp, weft = (bend(*pair, exists) for pair in both)
    return warp, weft


def _turn_parts(layout: Layout, x: Vector) -> tuple[Parts, Parts]:
    columns = layout.shape[1]

    def shifted(shift: int) -> Vector:
        """What is a shift away from each place, a line before the first vertex to one after."""
        return parts(x, layout.room - columns + shift, layout.length(-columns))

    def of(axis: int) -> Parts:
        step, aside = (columns, 1) if axis == 0 else (1, columns)
        place = shifted(0)
        after, before = (subtract(shifted(shift), place) for shift in (step, -step))
        where, last = np.indices(layout.shape)[1 - axis], layout.shape[1 - axis] - 1
        has_next, has_last = (layout.constant(where != end, -columns, x[0]) for end in (last, 0))
        forward = scale(has_next, subtract(shifted(aside), place))
        across = add(forward, scale(has_last, subtract(place, shifted(-aside))))
        # left of the axis is what is ahead along the weft, but what is behind along the warp
        return (across, before, after) if axis == 0 else (across, after, before)

    return of(0), of(1)


def _twist_parts(corners: Any) -> tuple[Parts, Parts]:
    a, b, c, d = corners
    warp = scale(0.5, subtract(add(c, d), add(a, b))), subtract(a, b), subtract(c, d)
    weft = scale(0.5, subtract(add(b, c), add(a, d))), subtract(c, b), subtract(a, d)
    return warp, weft


def _turn_exists(layout: Layout, axis: int, like: Array) -> Array:
    """Which places have a vertex inside of a line along an axis."""
    where = np.indices(layout.shape)[axis]
    inside = (where > 0) & (where < layout.shape[axis] - 1)
    return layout.constant(inside, -layout.shape[1], like) > 0


def _curvature(layout: Layout, angles: list[Array]) -> Vector:
    """Curvature (k11, k22, 2 k12) [1/m] of the vertices, from the angles of turns and twists."""
    columns, count = layout.shape[1], layout.count
    curvatures = []
    for axis, step in ((0, columns), (1, 1)):
        values = angles[axis] / layout.spacing[axis]
        values = jnp.where(_turn_exists(layout, axis, values), values, 0)
        own, after, before = (part(values, columns + s, count) for s in (0, step, -step))
        where = np.indices(layout.shape)[axis]
        first = layout.constant(where == 0, 0, own) > 0
        last = layout.constant(where == layout.shape[axis] - 1, 0, own) > 0
        curvatures.append(jnp.where(first, after, jnp.where(last, before, own)))
    cells = 2 * (angles[2] / layout.spacing[1] + angles[3] / layout.spacing[0])
    cells = part(cells, -layout.first_cell, count)
    # of a cell's twist in the curvature 2 k12 of the vertex that is its origin
    share = np.sqrt(np.prod(layout.spacing) / layout.vertex_areas) / 2
    share[-1], share[:, -1] = 0, 0
    share = layout.constant(share, 0, cells)
    return curvatures[0], curvatures[1], jnp.where(share > 0, share * cells, 0)
