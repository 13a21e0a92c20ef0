"""Forces on a sheet from substep to substep, with what the viscosity of its membrane remembers.

By slices where the mesh is a grid, by gathers elsewhere.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.arrays import once
from r2s.environment.air import Air, Fan, drag_on_vertices
from r2s.materials.fabric import Fabric
from r2s.materials.plate import PlateLaw
from r2s.mesh.mesh import Mesh
from r2s.mesh.vectors import Vector
from r2s.solvers.explicit.elements import bending_force, membrane_force, membrane_stress
from r2s.solvers.explicit.grid import grid_force, laws_on_grid
from r2s.solvers.explicit.grid_membrane import Samples
from r2s.solvers.explicit.layout import Layout, batch_last
from r2s.solvers.explicit.stability import Viscosity

Vertices = Float[Array, "vertex 3"]
Cells = tuple[tuple[int, int], tuple[float, float]]


class Memory(NamedTuple):
    """What the samples of a membrane remember of the substep before.

    - `relaxed`: stress (`r2s.solvers.explicit.stability`), [N/m].
    - `hidden`: scaled wrinkles; None: the mesh has none, or is no grid.
    - `begun`: whether there was a substep.
    """

    relaxed: Float[Array, "element sample 3"]
    hidden: Float[Array, "element sample 3"] | None
    begun: Array


class ForceInputs(NamedTuple):
    """All that the forces depend on, beside the mesh."""

    fabric: Fabric
    viscosity: Viscosity
    air: Air
    fan: Fan | None
    x: Vertices
    v: Vertices
    wind: Array
    memory: Memory


def cells_of(mesh: Mesh) -> Cells | None:
    """Vertices along warp and weft of a `rectangle` of quadrilaterals, and their spacing [m]."""
    corners = np.asarray(mesh.samples.corners)
    if corners.shape[1] != 4:
        return None
    rest = np.asarray(mesh.rest, float)
    columns = int(corners[0, 1] - corners[0, 0])
    shape = len(rest) // columns, columns
    size = rest[-1] - rest[0]
    return shape, (float(size[0]) / (shape[0] - 1), float(size[1]) / (columns - 1))


def no_memory(mesh: Mesh, cells: Cells | None, dtype: Any) -> Memory:
    """Before the first substep."""
    none = jnp.zeros((*mesh.samples.areas.shape, 3), dtype)
    wrinkles = cells is not None and mesh.samples.hidden_waves is not None
    return Memory(none, none if wrinkles else None, jnp.asarray(False))


def sheet_force(mesh: Mesh, cells: Cells | None, inputs: ForceInputs) -> tuple[Vertices, Memory]:
    """Forces [N] of membrane, bending and air on the vertices, and what the samples remember.

    `cells`: vertices along warp and weft of a rectangle of quadrilaterals, and the spacing between
    them [m]; None: any mesh.
    """
    if cells is None or not isinstance(inputs.fabric.bending, PlateLaw):
        return force_by_gathers(mesh, inputs)
    return batch_last(partial(_force_by_slices, *cells), inputs)


def force_by_gathers(mesh: Mesh, inputs: ForceInputs) -> tuple[Vertices, Memory]:
    """`sheet_force` on any mesh."""
    fabric, viscosity, air, fan, x, v, wind, memory = inputs
    past = memory.relaxed.reshape(-1, 3)
    stress = membrane_stress(mesh, fabric, x)
    stress, relaxed = viscosity.resist(stress, past, memory.begun)
    force = membrane_force(mesh, x, stress) + bending_force(mesh, fabric, x, v)
    force += drag_on_vertices(mesh, air, fan, x, v, wind)
    relaxed = relaxed.reshape(memory.relaxed.shape)
    return force, Memory(relaxed, memory.hidden, jnp.ones_like(memory.begun))


def slices(layout: Layout, inputs: ForceInputs) -> tuple[Callable, Samples]:
    """The forces on a grid as a function of positions and velocities with room (`Layout`), samples
    and whether there was a substep; and the samples at first. With a batch as last axis.
    """
    viscosity, air = jax.tree.map(layout.row, (inputs.viscosity, inputs.air))
    relaxed, hidden, _ = inputs.memory
    laws = laws_on_grid(layout, inputs.fabric, viscosity, hidden is not None)

    def force(x: Vector, v: Vector, samples: Samples, begun: Array) -> tuple[Vector, Samples]:
        flow = layout.flow(x, v, inputs.wind, inputs.fan)
        return grid_force(layout, laws, air, x, v, flow, samples, begun)

    known = None if hidden is None else layout.to_cells(hidden)
    return force, Samples(layout.to_cells(relaxed), known)


def remembered(layout: Layout, samples: Samples, begun: Array) -> Memory:
    """The samples of a grid as the memory of its cells."""
    hidden = None if samples.hidden is None else layout.from_cells(samples.hidden)
    return Memory(layout.from_cells(samples.relaxed), hidden, begun)


def _force_by_slices(shape, spacing, batched: bool, inputs: ForceInputs) -> tuple[Array, Memory]:
    layout = Layout(shape, spacing, batched)
    force_of, samples = slices(layout, inputs)
    begun = inputs.memory.begun
    x, v = layout.wide(inputs.x), layout.wide(inputs.v)
    force, samples = force_of(x, v, samples, layout.row(begun))
    # XLA would sum it up within the stack, element by element
    force = once(lambda *force: force, *force)
    return jnp.stack(force, axis=1), remembered(layout, samples, jnp.ones_like(begun))
