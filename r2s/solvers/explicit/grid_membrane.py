"""The membrane of a grid's quadrilaterals: forces on the corners of its cells.

The warp of a bilinear cell is linear along its weft, and the other way round, so that the 2 x 2
Gauss points share two of each. All samples lie in one row: those of all cells at the first of
`SAMPLES`, then at the next.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.materials.wrinkling import Prepared, follow, relieved
from r2s.mesh.strain_samples import GAUSS
from r2s.mesh.vectors import Vector, add, dot, scale, subtract
from r2s.solvers.explicit.laws import hiding_of
from r2s.solvers.explicit.layout import Layout, is_cell, part

PLACES = (1 - GAUSS) / 2, (1 + GAUSS) / 2  # of two points on (0, 1)
SAMPLES = (0, 0), (1, 0), (1, 1), (0, 1)  # places along warp and weft, as in `StrainSamples`
Corners = tuple[Vector, Vector, Vector, Vector]


class Samples(NamedTuple):
    """What the samples remember of the substep before, in a row.

    - `relaxed`: stress (`r2s.solvers.explicit.stability`), [N/m].
    - `hidden`: scaled wrinkles; None: the mesh has none.
    """

    relaxed: Vector
    hidden: Vector | None


def membrane_force(
    layout: Layout, laws: Any, corners: Corners, before: Samples, begun: Array
) -> tuple[list[Vector], Samples]:
    """Forces [N] on the corners of the cells, and what the samples remember of it.

    `begun`: whether there was a substep before.
    """
    strain = _row(once(partial(_strains, layout), corners))
    law, hidden = None, before.hidden
    if hidden is not None:
        law = hiding_of(laws.membrane, laws.critical, laws.membrane.elastic(strain)[1])
        hidden = follow(law, strain, hidden)
    of_axes = once(partial(_stress, laws, law), strain, hidden, before.relaxed, begun)
    total, relaxed = zip(*of_axes, strict=True)
    return _forces(layout, corners, _cells(layout, total)), Samples(relaxed, hidden)


def _stress(
    laws: Any,
    law: Prepared | None,
    strain: Vector,
    hidden: Vector | None,
    relaxed: Vector,
    begun: Array,
) -> list[tuple[Array, Array]]:
    """With viscosity, and what the samples remember of it, for (11, 22, 12)."""
    found, _ = laws.membrane.elastic(strain)
    if law is not None and hidden is not None:
        found = add(found, relieved(law, hidden))
    parts = zip(found, relaxed, strict=True)
    return [laws.viscosity.resist(now, past, begun) for now, past in parts]


def _strains(layout: Layout, corners: Corners) -> list[Vector]:
    """Of the cells at each sample."""
    warps, wefts = _sides(layout, corners)
    found = []
    for along, across in SAMPLES:
        warp, weft = warps[across], wefts[along]
        found.append(((dot(warp, warp) - 1) / 2, (dot(weft, weft) - 1) / 2, dot(warp, weft)))
    return found


def _row(samples: list[Vector]) -> Vector:
    one, two, three = (jnp.concatenate(parts) for parts in zip(*samples, strict=True))
    return one, two, three


def _cells(layout: Layout, row: Vector) -> list[Vector]:
    """The reverse of `_row`."""
    length = layout.length(layout.first_cell)
    begins = (sample * length for sample in range(len(SAMPLES)))
    return [
        (part(row[0], at, length), part(row[1], at, length), part(row[2], at, length))
        for at in begins
    ]


def _sides(layout: Layout, corners: Corners) -> tuple[list[Vector], list[Vector]]:
    """Images of unit warp at both places along the weft, and of unit weft along the warp."""
    a, b, c, d = corners
    near, far = subtract(b, a), subtract(c, d)
    left, right = subtract(d, a), subtract(c, b)
    warp, weft = layout.spacing
    warps = [add(scale((1 - t) / warp, near), scale(t / warp, far)) for t in PLACES]
    wefts = [add(scale((1 - t) / weft, left), scale(t / weft, right)) for t in PLACES]
    return warps, wefts


def _forces(layout: Layout, corners: Corners, stresses: list[Vector]) -> list[Vector]:
    _, to_corners = jax.vjp(partial(_strains, layout), corners)
    inside = is_cell(layout, corners[0][0])
    area = jnp.asarray(layout.spacing[0] * layout.spacing[1] / 4, corners[0][0].dtype)
    weight = jnp.where(inside, -area, 0)
    return list(to_corners([scale(weight, stress) for stress in stresses])[0])
