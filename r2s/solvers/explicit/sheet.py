"""Forces on the vertices of a sheet from substep to substep, on any mesh.

Strains, curvatures and laws are those of `r2s.ImplicitCloth`; here they give forces.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.environment.air import Air, Fan, drag_on_vertices
from r2s.materials.fabric import Fabric
from r2s.materials.wrinkling import membrane_on_samples, stress_on_samples
from r2s.mesh.mesh import Mesh
from r2s.mesh.vectors import Vector, columns
from r2s.solvers.explicit.stability import Viscosity

Vertices = Float[Array, "vertex 3"]
OfSamples = Float[Array, "element sample 3"]
Cells = tuple[tuple[int, int], tuple[float, float]]


class Memory(NamedTuple):
    """What the samples of a membrane remember of the substep before.

    - `relaxed`: stress (`Viscosity`), [N/m]: (element, sample, 3), or a row of all for each of
      three components.
    - `hidden`: scaled wrinkles, likewise; None: the mesh has none, or is no grid.
    - `begun`: whether there was a substep.
    """

    relaxed: Any
    hidden: Any
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

    @classmethod
    def make(
        cls, solver: Any, fabric: Fabric, state: Any, wind: Array | None, memory: Memory, dt: Any
    ) -> "ForceInputs":
        """Of a solver with a scene, a membrane damping and a relaxation, in steps of `dt` [s]."""
        x, v, scene = state.x, state.v, solver.scene
        damping = fabric.damping if solver.membrane_damping is None else solver.membrane_damping
        viscosity = Viscosity.make(damping, solver.relaxation, jnp.asarray(dt, x.dtype))
        wind = jnp.zeros(3, x.dtype) if wind is None else wind
        return cls(fabric, viscosity, scene.air, scene.fan, x, v, wind, memory)


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


class Gathers(NamedTuple):
    """Any mesh, with the methods of `grid.Slices`; its arrays have no room."""

    mesh: Mesh

    def row(self, number: Array) -> Array:
        """A number, for arrays over the vertices."""
        return number

    def areas(self, like: Array) -> Array:
        """Rest areas of the vertices, [m^2]."""
        return self.mesh.vertex_area

    def wide(self, x: Vertices) -> Vector:
        """Components of vectors of the vertices."""
        return columns(x)

    def inner(self, x: Vector) -> Vector:
        """Those of the vertices alone."""
        return x

    def put(self, wide: Vector, x: Vector) -> Vector:
        """The reverse of `inner`."""
        return x

    def forces(self, inputs: ForceInputs) -> tuple[Callable, Memory]:
        """The forces as a function of components of positions, of velocities, and memory; and the
        memory at first.
        """

        def force(x: Vector, v: Vector, memory: Memory) -> tuple[Vector, Memory]:
            moved = {"x": jnp.stack(x, axis=1), "v": jnp.stack(v, axis=1), "memory": memory}
            total, memory = force_by_gathers(self.mesh, inputs._replace(**moved))
            return self.wide(total), memory

        return force, inputs.memory

    def remembered(self, memory: Memory) -> Memory:
        """The memory of the cells."""
        return memory


def force_by_gathers(mesh: Mesh, inputs: ForceInputs) -> tuple[Vertices, Memory]:
    """Forces [N] of membrane, bending and air on the vertices, and what the samples remember."""
    fabric, viscosity, air, fan, x, v, wind, memory = inputs
    stress = membrane_stress(mesh, fabric, x)
    stress, relaxed = viscosity.resist(stress, memory.relaxed, memory.begun)
    force = membrane_force(mesh, x, stress) + bending_force(mesh, fabric, x, v)
    force += drag_on_vertices(mesh, air, fan, x, v, wind)
    return force, Memory(relaxed, memory.hidden, jnp.ones_like(memory.begun))


def membrane_stress(mesh: Mesh, fabric: Fabric, x: Vertices) -> OfSamples:
    """Of all strain samples at positions [m], [N/m]."""
    strain = mesh.samples.strains(x)
    laws = membrane_on_samples(mesh.samples, fabric.membrane, fabric.bending, strain)
    return stress_on_samples(laws, strain)


def membrane_force(mesh: Mesh, x: Vertices, stress: OfSamples) -> Vertices:
    """Forces [N] of stresses [N/m] on the vertices."""
    _, to_forces = jax.vjp(mesh.samples.strains, x)
    return -to_forces(mesh.samples.areas[:, :, None] * stress)[0]


def bending_force(mesh: Mesh, fabric: Fabric, x: Vertices, v: Vertices) -> Vertices:
    """Forces [N] of bending with Kelvin-Voigt viscosity on the vertices."""
    law, areas = fabric.bending, fabric.bending.areas(mesh)
    bends = law.bends(mesh)

    def bend(x: Vertices) -> Array:
        return law.curvatures(mesh, bends.curvatures_at(x))

    bent = law.on_elements(mesh, bends.curvatures_at(x))

    def moments(curvature: Array) -> Array:
        return jax.vmap(lambda law, k: jax.grad(law.energy_density)(k))(bent, curvature)

    curvature, rate = jax.jvp(bend, (x,), (v,))
    moment, viscous = jax.jvp(moments, (curvature,), (rate,))
    _, to_forces = jax.vjp(bend, x)
    areas = areas if curvature.ndim == 1 else areas[:, None]
    return -to_forces(areas * (moment + fabric.damping * viscous))[0]
