"""The membrane of a grid's quadrilaterals: forces on the corners of its cells.

The warp of a bilinear cell is linear along its weft, and the other way round, so that the 2 x 2
Gauss points share two of each.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from r2s.forces.laws import hiding_of
from r2s.forces.layout import Layout, is_cell
from r2s.geometry.strain_samples import GAUSS
from r2s.geometry.vectors import Vector, add, dot, scale, subtract
from r2s.laws.wrinkling import follow, relieved
from r2s.once import once

PLACES = (1 - GAUSS) / 2, (1 + GAUSS) / 2  # of two points on (0, 1)
SAMPLES = (0, 0), (1, 0), (1, 1), (0, 1)  # places along warp and weft, as in `StrainSamples`
Corners = tuple[Vector, Vector, Vector, Vector]
Wrinkles = tuple[Vector, Vector, Vector, Vector] | None


def membrane_force(
    layout: Layout, laws: Any, corners: Corners, rates: Corners, hidden: Wrinkles
) -> tuple[list[Vector], Wrinkles]:
    """Forces [N] on the corners of the cells, and the wrinkles of the samples."""
    warps, wefts = _sides(layout, corners)
    stresses, found = once(partial(_stresses, layout, laws), corners, rates, hidden)
    return _forces(layout, warps, wefts, stresses), found


def _stresses(layout: Layout, laws: Any, corners: Corners, rates: Corners, hidden: Wrinkles):
    """Of the four samples of every cell, with viscosity, and their wrinkles."""
    warps, wefts = _sides(layout, corners)
    warp_rates, weft_rates = _sides(layout, rates)
    stresses, found = [], []
    for sample, (along, across) in enumerate(SAMPLES):
        warp, weft = warps[across], wefts[along]
        warp_rate, weft_rate = warp_rates[across], weft_rates[along]
        strain = (dot(warp, warp) - 1) / 2, (dot(weft, weft) - 1) / 2, dot(warp, weft)
        rate = (
            dot(warp, warp_rate),
            dot(weft, weft_rate),
            dot(warp, weft_rate) + dot(warp_rate, weft),
        )
        stress, stiffness = laws.membrane.stress(strain, rate, laws.membrane_damping)
        if hidden is not None:
            law = hiding_of(laws.membrane, laws.critical, stiffness)
            moved, moving = follow(law, strain, rate, hidden[sample])
            total = add(moved, scale(laws.membrane_damping, moving))
            stress = add(stress, relieved(law, total))
            found.append(moved)
        stresses.append(stress)
    return stresses, tuple(found) if hidden is not None else None


def _sides(layout: Layout, corners: Corners) -> tuple[list[Vector], list[Vector]]:
    """Images of unit warp at both places along the weft, and of unit weft along the warp."""
    a, b, c, d = corners
    near, far = subtract(b, a), subtract(c, d)
    left, right = subtract(d, a), subtract(c, b)
    warp, weft = layout.spacing
    warps = [add(scale((1 - t) / warp, near), scale(t / warp, far)) for t in PLACES]
    wefts = [add(scale((1 - t) / weft, left), scale(t / weft, right)) for t in PLACES]
    return warps, wefts


def _forces(layout: Layout, warps, wefts, stresses) -> list[Vector]:
    warp, weft = layout.spacing
    inside = is_cell(layout, warps[0][0])
    area = jnp.asarray(warp * weft / 4, warps[0][0].dtype)
    zero = jnp.zeros_like(area)

    def pull(place: int, axis: int) -> Vector:
        """Of the yarns along an axis, at a place across them, [N]."""
        samples = [s for s, places in enumerate(SAMPLES) if places[1 - axis] == place]
        own: Array = sum((stresses[s][axis] for s in samples), start=zero)
        yarns, others = (warps, wefts) if axis == 0 else (wefts, warps)
        total = scale(own, yarns[place])
        for s in samples:
            total = add(total, scale(stresses[s][2], others[SAMPLES[s][axis]]))
        weight = jnp.where(inside, area / layout.spacing[axis], 0)
        return scale(weight, total)

    pulls = [pull(place, axis) for axis in (0, 1) for place in (0, 1)]
    first, second, third, fourth = pulls
    near = add(scale(PLACES[1], first), scale(PLACES[0], second))
    far = add(scale(PLACES[0], first), scale(PLACES[1], second))
    left = add(scale(PLACES[1], third), scale(PLACES[0], fourth))
    right = add(scale(PLACES[0], third), scale(PLACES[1], fourth))
    none = scale(0.0, near)
    of_a, of_b = add(near, left), subtract(right, near)
    return [of_a, of_b, subtract(subtract(none, far), right), subtract(far, left)]
