"""Forces on the vertices of a grid's quadrilaterals: membrane, bending and air, by slices.

The strains, curvatures and laws are those of `r2s.solvers.explicit.elements` on a `rectangle`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.environment.air import STILL, Air
from r2s.materials.fabric import Fabric
from r2s.mesh.vectors import Vector, add, cross, dot, scale, subtract
from r2s.solvers.explicit.grid_bending import bending_force, twists
from r2s.solvers.explicit.grid_membrane import Samples, membrane_force
from r2s.solvers.explicit.laws import Response, critical_stress, response
from r2s.solvers.explicit.layout import Layout, is_cell, part
from r2s.solvers.explicit.stability import Viscosity


class GridLaws(NamedTuple):
    """A fabric as the grid's forces need it; all that does not change from substep to substep.

    - `critical`: compressive stress at which cells buckle (2, ...) [N/m]; None: they do not.
    - `damping`: damping time of bending, [s]. `viscosity`: of the membrane.
    """

    membrane: Response
    bending: Response
    critical: Array | None
    damping: Array
    viscosity: Viscosity


def laws_on_grid(layout: Layout, fabric: Fabric, viscosity: Viscosity, wrinkling: bool) -> GridLaws:
    """Of a fabric whose arrays have the members, if any, as their last axis.

    The viscosity fits arrays (place, member).
    """
    waves = 2 * np.pi / layout.spacing[0], 2 * np.pi / layout.spacing[1]
    return GridLaws(
        response(fabric.membrane, layout.batched),
        response(fabric.bending, layout.batched),
        critical_stress(fabric, waves, layout.batched) if wrinkling else None,
        layout.row(fabric.damping),
        viscosity,
    )


def grid_force(
    layout: Layout,
    laws: GridLaws,
    air: Air,
    x: Vector,
    v: Vector,
    flow: Vector,
    samples: Samples,
    begun: Array,
) -> tuple[Vector, Samples]:
    """Forces [N] on the vertices, and what the samples remember of this substep.

    - `x`, `v`: positions [m] and velocities [m/s], with room (`Layout`).
    - `air`: its numbers fit arrays (place, member).
    - `flow`: velocities less the wind's, [m/s].
    - `samples`: of the substep before, if it has `begun`.
    """
    corners, rates = cell_corners(layout, x), cell_corners(layout, v)
    of_cells, samples = membrane_force(layout, laws, corners, samples, begun)
    pushed = _drag(layout, air, corners, cell_corners(layout, flow))
    twisted = once(partial(twists, layout), corners, rates)
    of_twists, of_turns = bending_force(layout, laws, x, v, twisted)
    total = tuple(add(a, b, pushed) for a, b in zip(of_cells, of_twists, strict=True))
    _, to_places = jax.vjp(partial(cell_corners, layout), x)  # it is linear: of anything
    one, two, three = (part(each, layout.room, layout.count) for each in to_places(total)[0])
    return add((one, two, three), of_turns), samples


def cell_corners(layout: Layout, x: Vector) -> tuple[Vector, Vector, Vector, Vector]:
    """The corners a, b, c, d of all cells, of an array with room."""
    first = layout.first_cell
    length, columns = layout.length(first), layout.shape[1]
    begin = layout.room + first

    def corner(shift: int) -> Vector:
        one, two, three = (part(each, begin + shift, length) for each in x)
        return one, two, three

    return corner(0), corner(columns), corner(columns + 1), corner(1)


def _drag(layout: Layout, air: Air, corners, flows) -> Vector:
    """A quarter of the drag on each cell [N]: minus the gradient of `Air.dissipation`."""
    a, b, c, d = corners
    normal = scale(0.5, cross(subtract(c, a), subtract(d, b)))
    inside = is_cell(layout, a[0])
    relative = scale(0.25, add(*flows))
    squared = jnp.where(inside, dot(normal, normal), 1)
    # a cell without area would have no normal
    area = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    along = dot(relative, normal) / area
    tangential = subtract(relative, scale(along / area, normal))
    slow = dot(tangential, tangential)
    speed = jnp.sqrt(slow + STILL**2)
    quarter = jnp.where(inside, -air.density / 8, 0)
    pressure = quarter * air.drag_coefficient * jnp.abs(along) * along
    friction = air.friction_coefficient / 3 * (2 * speed + slow / speed)
    return add(scale(pressure, normal), scale(quarter * area * friction, tangential))
