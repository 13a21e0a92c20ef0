"""The bending of a grid's plate: turns of its lines at the vertices, twists of its cells.

The same as `PlateElements.of_grid`: a vertex has the curvatures of its two turns, or of the nearest
ones at the border, and of the cell whose origin it is.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.mesh.plate_elements import grid_areas
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
    twisted = once(partial(_twists, layout), corners, rates)
    turned = once(partial(_turns, layout), x, v)
    bent = (*turned, *twisted)
    curvature = _curvature(layout, [bend.angle for bend in bent])
    rate = _curvature(layout, [bend.rate for bend in bent])
    stress = laws.bending.damped(curvature, rate, laws.damping)
    warp, weft, twist = scale(layout.areas(stress[0]), stress)
    share = layout.constant(_of_cell(layout), layout.first_cell, twist)
    twist = jnp.where(share > 0, -2 * share * layout.padded(twist, -layout.first_cell, 0), 0)
    strengths = tuple(
        tuple(scale(twist / layout.spacing[1 - axis], gradient) for gradient in bend.gradients)
        for axis, bend in enumerate(twisted)
    )
    _, to_corners = jax.vjp(_twist_parts, corners)  # it is linear: of anything
    of_warp, of_weft = (
        _turn_force(layout, axis, turned[axis], moment) for axis, moment in ((0, warp), (1, weft))
    )
    return to_corners(strengths)[0], add(of_warp, of_weft)


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
        has_next, has_last = _borders(layout, axis, x[0])
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
    share = layout.constant(_of_cell(layout), 0, cells)
    return curvatures[0], curvatures[1], jnp.where(share > 0, share * cells, 0)


def _of_cell(layout: Layout) -> np.ndarray:
    """The share of a cell's twist in the curvature 2 k12 of the vertex that is its origin."""
    areas = grid_areas(layout.spacing, layout.shape)
    share = np.sqrt(np.prod(layout.spacing) / areas) / 2
    share[-1], share[:, -1] = 0, 0
    return share


def _turn_force(layout: Layout, axis: int, turned: Bent, moment: Array) -> Vector:
    """Forces [N] on the vertices, from moments [N m^2] that go with their curvature.

    By sums of slices: the transposes of slices, which JAX would take, are slower.
    """
    columns, count = layout.shape[1], layout.count
    step, aside = (columns, 1) if axis == 0 else (1, columns)
    where, last = np.indices(layout.shape)[axis], layout.shape[axis] - 1
    wide = layout.padded(moment, 2 * columns, 2 * columns)
    length = layout.length(-columns)
    own, after, before = (part(wide, columns + s, length) for s in (0, step, -step))
    next_to_first = layout.constant(where == 1, -columns, own)
    next_to_last = layout.constant(where == last - 1, -columns, own)
    total = own + next_to_first * before + next_to_last * after
    exists = _turn_exists(layout, axis, own)
    strength = jnp.where(exists, -total / layout.spacing[axis], 0)
    of_axis, of_left, of_right = (scale(strength, gradient) for gradient in turned.gradients)
    of_next, of_last = (of_left, of_right) if axis == 1 else (of_right, of_left)
    has_next, has_last = _borders(layout, axis, own)
    forward, backward = scale(has_next, of_axis), scale(has_last, of_axis)
    of_own = subtract(subtract(backward, forward), add(of_next, of_last))

    def shifted(x: Vector, shift: int) -> Vector:
        return parts(x, columns + shift, count)

    ends = add(shifted(of_next, -step), shifted(of_last, step))
    sides = subtract(shifted(forward, -aside), shifted(backward, aside))
    return add(shifted(of_own, 0), ends, sides)


def _borders(layout: Layout, axis: int, like: Array) -> tuple[Array, Array]:
    """Whether a place has a next and a last one across an axis."""
    where, last = np.indices(layout.shape)[1 - axis], layout.shape[1 - axis] - 1
    columns = layout.shape[1]
    return (
        layout.constant(where != last, -columns, like),
        layout.constant(where != 0, -columns, like),
    )
