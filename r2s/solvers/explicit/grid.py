"""Forces on the vertices of a `rectangle` of quadrilaterals, by slices: membrane, bending and air.

The same as by gathers (`sheet`). The warp of a bilinear cell is linear along its weft, and the
other way round, so that the 2 x 2 Gauss points share two of each. All samples lie in one row: those
of all cells at the first of `SAMPLES`, then at the next.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r2s._util.arrays import once
from r2s.environment.air import STILL, Air, Fan
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import OrthotropicPlate, PlateBending, PlateLaw
from r2s.materials.wrinkling import Prepared, follow, mean_bending, prepare_search, relieved
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import GAUSS
from r2s.mesh.vectors import Vector, add, cross, dot, scale, subtract
from r2s.solvers.explicit.grid_bending import bending_force
from r2s.solvers.explicit.layout import Layout, batch_last, parts
from r2s.solvers.explicit.sheet import Cells, ForceInputs, Memory, Vertices, force_by_gathers
from r2s.solvers.explicit.stability import Viscosity

CONSTANT = OrthotropicMembrane, PlateBending, OrthotropicPlate  # laws of constant stiffness
PLACES = (1 - GAUSS) / 2, (1 + GAUSS) / 2  # of two points on (0, 1)
SAMPLES = (0, 0), (1, 0), (1, 1), (0, 1)  # places along warp and weft, as in `StrainSamples`
Corners = tuple[Vector, Vector, Vector, Vector]


class Response(NamedTuple):
    """A membrane or a plate, for arrays (place), or (place, member).

    - `law`: of one element, or one of each member along the last axis of its arrays.
    - `stiffness`: (3, 3, 1), or (3, 3, 1, member), of a law of constant stiffness; None: of others.
    - `batched`: whether there are members.
    """

    law: Any
    stiffness: Array | None
    batched: bool

    @classmethod
    def make(cls, law: Any, batched: bool) -> "Response":
        """Of a law whose arrays have the members, if any, as their last axis."""
        if not isinstance(law, CONSTANT):
            return cls(law, None, batched)

        def of_one(law):
            zero = jnp.zeros(3, jax.tree.leaves(law)[0].dtype)
            return jax.hessian(law.energy_density)(zero)

        of_all = jax.vmap(of_one, in_axes=-1, out_axes=-1) if batched else of_one
        return cls(law, of_all(law)[:, :, None], batched)

    def elastic(self, strain: Vector) -> tuple[Vector, Array]:
        """Stress, and stiffness at zero strain (3, 3, ...)."""
        if self.stiffness is not None:
            return self._linear(strain), self.stiffness
        (one, two, three), _, stiffness = self._of_places(strain, strain)
        return (one, two, three), stiffness

    def damped(self, strain: Vector, rate: Vector, damping: Array) -> Vector:
        """Stress with Kelvin-Voigt viscosity.

        - `rate`: of the strain, [1/s]; `damping`: damping time, [s].
        """
        if self.stiffness is not None:
            return self._linear(add(strain, scale(damping, rate)))
        (one, two, three), viscous, _ = self._of_places(strain, rate)
        return add((one, two, three), scale(damping, tuple(viscous)))

    def _linear(self, strain: Vector) -> Vector:
        assert self.stiffness is not None
        one, two, three = (dot((row[0], row[1], row[2]), strain) for row in self.stiffness)
        return one, two, three

    def _of_places(self, strain: Vector, rate: Vector):
        of_places = jax.vmap(_stresses, in_axes=(None, 1, 1), out_axes=-1)
        if self.batched:
            of_places = jax.vmap(of_places, in_axes=-1, out_axes=-1)
        return of_places(self.law, jnp.stack(strain), jnp.stack(rate))


def _stresses(law: Any, strain: Array, rate: Array) -> tuple[Array, Array, Array]:
    law = law.at(strain)
    stress, viscous = jax.jvp(jax.grad(law.energy_density), (strain,), (rate,))
    return stress, viscous, jax.hessian(law.energy_density)(jnp.zeros_like(strain))


class GridLaws(NamedTuple):
    """What does not change from substep to substep, for arrays (place) or (place, member).

    - `critical`: compressive stress at which cells buckle (2, ...) [N/m]; None: they do not.
    - `damping`: damping time of bending, [s]. `viscosity`: of the membrane.
    """

    membrane: Response
    bending: Response
    critical: Array | None
    damping: Array
    viscosity: Viscosity
    air: Air


class Slices(Layout):
    """A grid with its forces."""

    def forces(self, inputs: ForceInputs) -> tuple[Callable, Memory]:
        """The forces as a function of components of positions and velocities with room, and memory;
        and the memory at first. A batch is the last axis.
        """
        fabric, (relaxed, hidden, begun) = inputs.fabric, inputs.memory
        viscosity, air = jax.tree.map(self.row, (inputs.viscosity, inputs.air))
        laws = GridLaws(
            Response.make(fabric.membrane, self.batched),
            Response.make(fabric.bending, self.batched),
            None if hidden is None else self._critical_stress(fabric),
            self.row(fabric.damping),
            viscosity,
            air,
        )

        def force(x: Vector, v: Vector, memory: Memory) -> tuple[Vector, Memory]:
            flow = self._flow(x, v, inputs.wind, inputs.fan)
            return grid_force(self, laws, x, v, flow, memory)

        hidden = None if hidden is None else self.to_cells(hidden)
        return force, Memory(self.to_cells(relaxed), hidden, self.row(begun))

    def remembered(self, memory: Memory) -> Memory:
        """The memory of the cells."""
        hidden = None if memory.hidden is None else self.from_cells(memory.hidden)
        begun = memory.begun[0] if self.batched else memory.begun
        return Memory(self.from_cells(memory.relaxed), hidden, begun)

    def _critical_stress(self, fabric: Fabric) -> Array:
        """Compressive stress (2, 1, ...) [N/m] at which cells buckle."""
        squares = jnp.asarray([(2 * np.pi / length) ** 2 for length in self.spacing], float)
        if not self.batched:
            return (mean_bending(fabric.bending) * squares)[:, None]
        bent = jax.vmap(mean_bending, in_axes=-1)(fabric.bending)
        return squares[:, None, None] * bent[None, None]

    def _flow(self, x: Vector, v: Vector, wind: Array, fan: Fan | None) -> Vector:
        """Velocities [m/s] less the wind's: one for all vertices (3, ...), or (vertex, 3, ...)."""
        if wind.ndim == (2 if self.batched else 1):
            blowing = self.row(wind[0]), self.row(wind[1]), self.row(wind[2])
        else:
            blowing = self.wide(wind)
        if fan is not None:
            blows = jax.vmap(Fan.__call__, -1, -1) if self.batched else Fan.__call__
            blowing = scale(blows(fan, jnp.stack(x, axis=1)), blowing)
        return subtract(v, blowing)


def sheet_force(mesh: Mesh, cells: Cells | None, inputs: ForceInputs) -> tuple[Vertices, Memory]:
    """Forces [N] of membrane, bending and air on the vertices, and what the samples remember.

    `cells`: those of `cells_of`, for a grid; None: any mesh.
    """
    cells = grid_for(cells, inputs.fabric)
    if cells is None:
        return force_by_gathers(mesh, inputs)
    return batch_last(partial(_force_by_slices, cells), inputs)


def grid_for(cells: Cells | None, fabric: Fabric) -> Cells | None:
    """The grid of a mesh if the forces of a fabric can be worked out by slices there."""
    return cells if isinstance(fabric.bending, PlateLaw) else None


def _force_by_slices(cells: Cells, batched: bool, inputs: ForceInputs) -> tuple[Array, Memory]:
    layout = Slices(*cells, batched)
    force_of, memory = layout.forces(inputs)
    force, memory = force_of(layout.wide(inputs.x), layout.wide(inputs.v), memory)
    # XLA would sum it up within the stack, element by element
    force = once(lambda *force: force, *force)
    return jnp.stack(force, axis=1), layout.remembered(memory)


def grid_force(
    layout: Layout, laws: GridLaws, x: Vector, v: Vector, flow: Vector, memory: Memory
) -> tuple[Vector, Memory]:
    """Forces [N] on the vertices, and what the samples remember of this substep.

    - `x`, `v`: positions [m] and velocities [m/s], with room (`Layout`).
    - `flow`: velocities less the wind's, [m/s].
    """
    corners, rates = cell_corners(layout, x), cell_corners(layout, v)
    of_cells, memory = membrane_force(layout, laws, corners, memory)
    pushed = _drag(layout, laws.air, corners, cell_corners(layout, flow))
    of_twists, of_turns = bending_force(layout, laws, x, v, corners, rates)
    total = tuple(add(a, b, pushed) for a, b in zip(of_cells, of_twists, strict=True))
    _, to_places = jax.vjp(partial(cell_corners, layout), x)  # it is linear: of anything
    return add(layout.inner(to_places(total)[0]), of_turns), memory


def cell_corners(layout: Layout, x: Vector) -> Corners:
    """The corners a, b, c, d of all cells, of an array with room."""
    columns, length = layout.shape[1], layout.length(layout.first_cell)
    begin = layout.room + layout.first_cell
    a, b, c, d = (parts(x, begin + shift, length) for shift in (0, columns, columns + 1, 1))
    return a, b, c, d


def membrane_force(
    layout: Layout, laws: GridLaws, corners: Corners, before: Memory
) -> tuple[list[Vector], Memory]:
    """Forces [N] on the corners of the cells, and what the samples remember of it."""
    samples = once(partial(_strains, layout), corners)
    one, two, three = (jnp.concatenate(row) for row in zip(*samples, strict=True))
    strain, search = (one, two, three), None
    if before.hidden is not None:
        search = prepare_search(laws.membrane.elastic(strain)[1], laws.critical)
        before = before._replace(hidden=follow(search, strain, before.hidden))
    of_axes = once(partial(_stress, laws, search), strain, before)
    total, relaxed = zip(*of_axes, strict=True)
    length = layout.length(layout.first_cell)
    stresses = [parts(total, sample * length, length) for sample in range(len(SAMPLES))]
    _, to_corners = jax.vjp(partial(_strains, layout), corners)
    like = corners[0][0]
    area = jnp.asarray(layout.spacing[0] * layout.spacing[1] / 4, like.dtype)
    weight = jnp.where(layout.is_cell(like), -area, 0)
    forces = list(to_corners([scale(weight, stress) for stress in stresses])[0])
    return forces, Memory(relaxed, before.hidden, jnp.ones_like(before.begun))


def _stress(laws: GridLaws, search: Prepared | None, strain: Vector, memory: Memory):
    """With viscosity, and what the samples remember of it, for (11, 22, 12)."""
    stress, _ = laws.membrane.elastic(strain)
    if search is not None:
        stress = add(stress, relieved(search, memory.hidden))
    axes = zip(stress, memory.relaxed, strict=True)
    return [laws.viscosity.resist(now, past, memory.begun) for now, past in axes]


def _strains(layout: Layout, corners: Corners) -> list[Vector]:
    """Of the cells at each sample."""
    a, b, c, d = corners
    near, far, left, right = subtract(b, a), subtract(c, d), subtract(d, a), subtract(c, b)
    along, across = layout.spacing
    # images of unit warp at both places along the weft, and of unit weft along the warp
    warps = [add(scale((1 - t) / along, near), scale(t / along, far)) for t in PLACES]
    wefts = [add(scale((1 - t) / across, left), scale(t / across, right)) for t in PLACES]
    strains = []
    for i, j in SAMPLES:
        warp, weft = warps[j], wefts[i]
        strains.append(((dot(warp, warp) - 1) / 2, (dot(weft, weft) - 1) / 2, dot(warp, weft)))
    return strains


def _drag(layout: Layout, air: Air, corners: Corners, flows: Corners) -> Vector:
    """A quarter of the drag on each cell [N]: minus the gradient of `Air.dissipation`."""
    a, b, c, d = corners
    normal = scale(0.5, cross(subtract(c, a), subtract(d, b)))
    inside = layout.is_cell(a[0])
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
