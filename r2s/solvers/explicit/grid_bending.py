"""The bending of a grid's plate: turns of its lines at the vertices, twists of its cells.

The same as `PlateElements.of_grid`: a vertex has the curvatures of its two turns, or of the nearest
ones at the border, and of the cell whose origin it is.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.mesh.vectors import Vector, add, cross, dot, scale, subtract
from r2s.solvers.explicit.layout import Layout, is_cell, part


class Turned(NamedTuple):
    """A bend of an axis with two wings (`r2s.mesh.bends`), by its vectors.

    - `angle`, `rate`: [rad] and [rad/s].
    - `axis`, `left`, `right`: derivatives of the angle in axis and wings, [rad/m].
    """

    angle: Array
    rate: Array
    axis: Vector
    left: Vector
    right: Vector


def bend(parts: tuple[Vector, Vector, Vector], rates, exists: Array) -> Turned:
    """Of axis, left and right wing [m], and their rates [m/s]; anything where none `exists`."""
    axis, left, right = parts
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
    return Turned(angle, rate, by_axis, by_left, by_right)


def twists(layout: Layout, corners, rates) -> tuple[Turned, Turned]:
    """The twists of all cells, between their sides along the warp and along the weft."""
    exists = is_cell(layout, corners[0][0])

    def of_warp(a, b, c, d):
        axis = scale(0.5, subtract(add(c, d), add(a, b)))
        return axis, subtract(a, b), subtract(c, d)

    def of_weft(a, b, c, d):
        axis = scale(0.5, subtract(add(b, c), add(a, d)))
        return axis, subtract(c, b), subtract(a, d)

    warp = bend(of_warp(*corners), of_warp(*rates), exists)
    return warp, bend(of_weft(*corners), of_weft(*rates), exists)


def turns(layout: Layout, x: Vector, v: Vector) -> tuple[Turned, Turned]:
    """The turns of the lines along warp and along weft, from a line before the first vertex on."""

    def of(x: Vector, axis: int) -> tuple[Vector, Vector, Vector]:
        here = shifted(layout, x, 0)
        ahead, behind = _step(layout, axis)
        beside, before = _step(layout, 1 - axis)
        wings = [subtract(shifted(layout, x, shift), here) for shift in (ahead, behind)]
        has_next, has_last = (border(layout, 1 - axis, end, x[0]) for end in (-1, 0))
        forward = scale(has_next, subtract(shifted(layout, x, beside), here))
        backward = scale(has_last, subtract(here, shifted(layout, x, before)))
        across = add(forward, backward)
        # left of the axis is what is ahead along the weft, but what is behind along the warp
        return (across, wings[1], wings[0]) if axis == 0 else (across, wings[0], wings[1])

    warp, weft = (bend(of(x, a), of(v, a), turn_exists(layout, a, x[0])) for a in (0, 1))
    return warp, weft


def bending_force(
    layout: Layout, laws: Any, x: Vector, v: Vector, twisted: tuple[Turned, Turned]
) -> tuple[list[Vector], Vector]:
    """Forces [N] of the twists on the corners of the cells, and of the turns on the vertices."""
    turned = once(partial(turns, layout), x, v)
    curvature = _curvature(layout, turned, twisted, "angle")
    rate = _curvature(layout, turned, twisted, "rate")
    warp, weft, twist = laws.bending.damped(curvature, rate, laws.damping)
    areas = layout.constant(layout.vertex_areas, 0, warp)
    moments = areas * warp, areas * weft, areas * twist
    of_turns = [_turn_force(layout, axis, turned[axis], moments[axis]) for axis in (0, 1)]
    return _twist_force(layout, twisted, moments[2]), add(*of_turns)


def turn_exists(layout: Layout, axis: int, like: Array) -> Array:
    """Which places have a vertex inside of a line along an axis."""
    where = layout.index()[axis]
    inside = (where > 0) & (where < layout.shape[axis] - 1)
    return layout.constant(inside, -layout.shape[1], like) > 0


def border(layout: Layout, axis: int, end: int, like: Array) -> Array:
    """1 at all places but those at one end of the lines along an axis, 0 there."""
    last = layout.shape[axis] - 1 if end else 0
    return layout.constant(layout.index()[axis] != last, -layout.shape[1], like)


def shifted(layout: Layout, x: Vector, shift: int) -> Vector:
    """What is a shift away from each place, a line before the first vertex to one after."""
    columns = layout.shape[1]
    begin, length = layout.room - columns + shift, layout.length(-columns)
    one, two, three = (part(each, begin, length) for each in x)
    return one, two, three


def _step(layout: Layout, axis: int) -> tuple[int, int]:
    """From a vertex to the next and to the last one along an axis."""
    return (layout.shape[1], -layout.shape[1]) if axis == 0 else (1, -1)


def _of_cell(layout: Layout) -> np.ndarray:
    """The share of a cell's twist in the curvature 2 k12 of the vertex that is its origin."""
    share = np.sqrt(np.prod(layout.spacing) / layout.vertex_areas) / 2
    share[-1], share[:, -1] = 0, 0
    return share


def _curvature(layout: Layout, turned, twisted, what: str) -> Vector:
    """Curvature (k11, k22, 2 k12) [1/m] of the vertices, or its rate."""
    columns, count = layout.shape[1], layout.count
    found = []
    for axis in (0, 1):
        values = getattr(turned[axis], what) / layout.spacing[axis]
        values = jnp.where(turn_exists(layout, axis, values), values, 0)
        ahead, behind = _step(layout, axis)
        here, after, before = (part(values, columns + s, count) for s in (0, ahead, behind))
        where = layout.index()[axis]
        first = layout.constant(where == 0, 0, here) > 0
        last = layout.constant(where == layout.shape[axis] - 1, 0, here) > 0
        found.append(jnp.where(first, after, jnp.where(last, before, here)))
    along, across = (getattr(each, what) for each in twisted)
    cells = 2 * (along / layout.spacing[1] + across / layout.spacing[0])
    cells = part(cells, -layout.first_cell, count)
    share = layout.constant(_of_cell(layout), 0, cells)
    return found[0], found[1], jnp.where(share > 0, share * cells, 0)


def _turn_force(layout: Layout, axis: int, turned: Turned, moment: Array) -> Vector:
    """Forces [N] on the vertices, from moments [N m^2] that go with their curvature."""
    columns, count = layout.shape[1], layout.count
    where, last = layout.index()[axis], layout.shape[axis] - 1
    ahead, behind = _step(layout, axis)
    wide = layout.padded(moment, 2 * columns, 2 * columns)
    length = layout.length(-columns)
    here, after, before = (part(wide, columns + s, length) for s in (0, ahead, behind))
    next_to_first = layout.constant(where == 1, -columns, here)
    next_to_last = layout.constant(where == last - 1, -columns, here)
    total = here + next_to_first * before + next_to_last * after
    exists = turn_exists(layout, axis, here)
    strength = jnp.where(exists, -total / layout.spacing[axis], 0)
    of_axis, of_left, of_right = (scale(strength, g) for g in turned[2:])
    of_next, of_last = (of_left, of_right) if axis == 1 else (of_right, of_left)
    has_next, has_last = (border(layout, 1 - axis, end, here) for end in (-1, 0))
    forward, backward = scale(has_next, of_axis), scale(has_last, of_axis)
    own = subtract(subtract(backward, forward), add(of_next, of_last))
    parts = own, of_next, of_last, forward, backward
    beside, aside = _step(layout, 1 - axis)

    def of_component(i: int) -> Array:
        own, of_next, of_last, forward, backward = (each[i] for each in parts)
        ends = part(of_next, columns - ahead, count) + part(of_last, columns - behind, count)
        sides = part(forward, columns - beside, count) - part(backward, columns - aside, count)
        return part(own, columns, count) + ends + sides

    return of_component(0), of_component(1), of_component(2)


def _twist_force(layout: Layout, twisted, moment: Array) -> list[Vector]:
    """Forces [N] on the corners of the cells, from moments [N m^2] of their origins."""
    share = layout.constant(_of_cell(layout), layout.first_cell, moment)
    wide = layout.padded(moment, -layout.first_cell, 0)
    strength = jnp.where(share > 0, -2 * share * wide, 0)
    warp, weft = (
        [scale(strength / layout.spacing[1 - axis], g) for g in twisted[axis][2:]]
        for axis in (0, 1)
    )
    half_warp, half_weft = scale(0.5, warp[0]), scale(0.5, weft[0])
    none = scale(0.0, half_warp)
    both, apart = add(half_warp, half_weft), subtract(half_warp, half_weft)
    of_a = subtract(add(warp[1], weft[2]), both)
    of_b = subtract(subtract(none, add(warp[1], weft[1])), apart)
    of_c = add(both, warp[2], weft[1])
    of_d = subtract(apart, add(warp[2], weft[2]))
    return [of_a, of_b, of_c, of_d]
