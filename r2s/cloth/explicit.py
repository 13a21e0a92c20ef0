"""The cloth in explicit steps: as many symplectic substeps in a step as its waves need.

The physics are those of `r2s.cloth.cloth.Cloth`. A substep needs no solve, and all its arrays are
worked on side by side: of a batch, its members. It pays where many fabrics or motions are needed
at once. For derivatives the implicit cloth is better: these would go through every substep.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from r2s.cloth.batch_last import batch_last
from r2s.cloth.substep import moved_velocity
from r2s.fabrics.fabric import Fabric
from r2s.failures import Failure, first_failure, no_failure
from r2s.forces.elements import bending_frequency, elastic_force, membrane_frequency
from r2s.forces.grid import grid_force, laws_on_grid
from r2s.forces.layout import Layout
from r2s.forces.stability import check_step, longest_step
from r2s.geometry.mesh import Mesh
from r2s.laws.plate import PlateLaw
from r2s.world.air import Air
from r2s.world.drag import drag_on_vertices
from r2s.world.scene import Control, Scene

Positions = Float[Array, "vertex 3"]

MEMBRANE_DAMPING = 1e-4  # [s]: what is longer costs many times the substeps, and hardly shows
REFUSED = (
    "explicit steps do not know contact of the sheet with itself: take the implicit cloth, "
    "r2s.Cloth.make(..., self_contact=True), or material points, r2s.material_points"
)


class ExplicitState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `hidden`: scaled wrinkles of every sample, from where the next substep goes on; None: the mesh
      has none, or is no grid.
    - `failure`: the first `r2s.failures.Failure` of the run so far.
    """

    x: Positions
    v: Positions
    hidden: Float[Array, "element sample 3"] | None
    failure: Int[Array, ""]


class ExplicitCloth(eqx.Module):
    """A sheet in a scene, stepped by symplectic Euler in substeps.

    `make` makes one. `jax.vmap` of `step` runs a batch with its members side by side.

    - `scene`: sheet, held vertices, table, air.
    - `membrane_damping`: damping time of the membrane, [s]; the fabric's holds for bending alone.
    - `dt`: step, [s]. `substeps`: in a step.
    - `grid`: vertices along warp and weft of a rectangle of quadrilaterals, and the spacing
      between them [m]; None: any other mesh, whose forces take several times as long.
    """

    scene: Scene
    membrane_damping: Float[Array, ""]
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    grid: tuple[tuple[int, int], tuple[float, float]] | None = eqx.field(static=True)

    @classmethod
    def make(
        cls,
        scene: Scene,
        dt: float,
        fabric: Fabric,
        membrane_damping: float = MEMBRANE_DAMPING,
        *,
        substeps: int | None = None,
        self_contact: bool = False,
    ) -> "ExplicitCloth":
        """A solver for a scene, whose mesh must not be traced.

        - `fabric`: the stiffest that it will be used for; of a batch, with a leading axis on every
          array, that is the member which needs the shortest substeps.
        - `substeps`: in a step; None: the fewest below `stable_step`.

        Raises `ValueError` for a step that is not positive, for substeps that are too long, with
        their limit, and for self-contact.
        """
        if self_contact:
            raise ValueError(REFUSED)
        if not (dt > 0 and membrane_damping >= 0):
            raise ValueError(
                f"dt must be positive and the damping time not negative, got {dt} s and "
                f"{membrane_damping} s"
            )
        damping = jnp.asarray(membrane_damping, float)
        with jax.ensure_compile_time_eval():
            longest = shortest(scene.mesh, fabric, damping)
            grid = grid_of(scene.mesh)
        if substeps is None:
            substeps = max(1, math.ceil(dt / longest * (1 + 1e-6)))
        solver = cls(scene, damping, float(dt), substeps, grid)
        solver._check_substep(longest)
        return solver

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` when the substeps are too long for a fabric, unless it is traced."""
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(fabric)):
            return
        with jax.ensure_compile_time_eval():
            self._check_substep(shortest(self.scene.mesh, fabric, self.membrane_damping))

    def _check_substep(self, longest: float) -> None:
        material = f"the fabric and the mesh (dt = {self.dt:g} s in {self.substeps} substeps)"
        check_step(self.dt / self.substeps, jnp.asarray(longest), material)

    def init(self, x: Positions, v: Positions | None = None) -> ExplicitState:
        """A state from positions [m] and velocities [m/s] (default: zero)."""
        v = jnp.zeros_like(x) if v is None else v
        hidden = None
        if self._wrinkles:
            hidden = jnp.zeros((*self.scene.mesh.samples.areas.shape, 3), x.dtype)
        return ExplicitState(x, v, hidden, no_failure())

    def step(self, fabric: Fabric, state: ExplicitState, control: Control) -> ExplicitState:
        """The state `dt` later, with the held vertices at `control.handles`."""
        return self._step(fabric, state, control, False)[0]

    def step_with_forces(
        self, fabric: Fabric, state: ExplicitState, control: Control
    ) -> tuple[ExplicitState, Float[Array, "handle 3"]]:
        """The state `dt` later, and the grippers' mean forces [N] on the held vertices."""
        after, impulse = self._step(fabric, state, control, True)
        return after, impulse[self.scene.held] / self.dt

    def _step(self, fabric: Fabric, state: ExplicitState, control: Control, with_impulse: bool):
        scene = self.scene
        carried = jnp.zeros_like(state.x)
        carried = carried.at[scene.held].set((control.handles - state.x[scene.held]) / self.dt)
        inputs = _Inputs(
            fabric,
            state.x,
            state.v,
            state.hidden,
            carried,
            scene.is_free.astype(state.x.dtype),
            control.wind,
            scene.table.height,
            scene.air,
            scene.fan,
            self.membrane_damping,
            jnp.zeros_like(state.x) if with_impulse else None,
        )
        if self.grid is not None and isinstance(fabric.bending, PlateLaw):
            x, v, hidden, impulse = self._on_grid(inputs)
        else:
            x, v, hidden, impulse = self._by_gathers(inputs)
        x = scene.place(x, control.handles)
        failure = first_failure(
            state.failure, _failure((state.x, state.v, fabric, control), (x, v))
        )
        return ExplicitState(x, v, hidden, failure), impulse

    @property
    def _wrinkles(self) -> bool:
        return self.grid is not None and self.scene.mesh.samples.hidden_waves is not None

    def _on_grid(self, inputs: "_Inputs"):
        assert self.grid is not None
        arrays, static = eqx.partition(inputs, eqx.is_array)
        advance = partial(_advance_grid, *self.grid, self.dt, self.substeps)
        return batch_last(lambda batched, arrays: advance(batched, eqx.combine(arrays, static)))(
            arrays
        )

    def _by_gathers(self, inputs: "_Inputs"):
        mesh, dt = self.scene.mesh, jnp.asarray(self.dt / self.substeps, inputs.x.dtype)
        fabric = inputs.fabric
        mass = fabric.density * mesh.vertex_area
        free, carried = inputs.is_free > 0, tuple(inputs.carried.T)

        def substep(state, _):
            x, v, impulse = state
            force = elastic_force(mesh, fabric, inputs.membrane_damping, x, v)
            force += drag_on_vertices(mesh, inputs.air, inputs.fan, x, v, inputs.wind)
            height = x[:, 2] - inputs.table_height - fabric.thickness
            others = fabric.density, fabric.friction, fabric.mass_damping
            moved = moved_velocity(dt, tuple(force.T), mass, tuple(v.T), height, *others)
            v = jnp.stack([jnp.where(free, m, c) for m, c in zip(moved, carried, strict=True)], 1)
            if impulse is not None:
                impulse += mass[:, None] * (v - jnp.stack(moved, axis=1))
            return (x + dt * v, v, impulse), None

        start = inputs.x, inputs.v, inputs.impulse
        (x, v, impulse), _ = jax.lax.scan(substep, start, length=self.substeps)
        return x, v, inputs.hidden, impulse


class _Inputs(NamedTuple):
    """All that a step depends on; with a batch as last axis in `_advance_grid`."""

    fabric: Fabric
    x: Array
    v: Array
    hidden: Array | None
    carried: Array  # velocities of held vertices
    is_free: Array
    wind: Array
    table_height: Array
    air: Air
    fan: Any
    membrane_damping: Array
    impulse: Array | None  # [N s], of the grippers, added up; None: it is not asked for


def _advance_grid(shape, spacing, dt, substeps: int, batched: bool, inputs: _Inputs):
    """Positions, velocities, wrinkles and impulses after the substeps of a step."""
    layout = Layout(shape, spacing, batched)
    fabric, count, room = inputs.fabric, layout.count, layout.room
    dt = jnp.asarray(dt / substeps, inputs.x.dtype)
    laws = laws_on_grid(layout, fabric, inputs.membrane_damping, inputs.hidden is not None)
    names = ("density", "friction", "mass_damping", "thickness")
    row = {name: layout.row(getattr(fabric, name)) for name in names}
    mass = row["density"] * layout.constant(layout.vertex_areas, 0, inputs.x)
    contact = layout.row(inputs.table_height) + row["thickness"]
    air = jax.tree.map(layout.row, inputs.air)
    free = inputs.is_free > 0
    carried = tuple(inputs.carried[:, i] for i in range(3))

    def inner(arrays):
        return tuple(each[room : room + count] for each in arrays)

    def put(wide, arrays):
        return tuple(w.at[room : room + count].set(a) for w, a in zip(wide, arrays, strict=True))

    def substep(_, state):
        x, v, hidden, impulse = state
        flow = layout.flow(x, v, inputs.wind, inputs.fan)
        force, hidden = grid_force(layout, laws, air, x, v, flow, hidden)
        here, before = inner(x), inner(v)
        height = here[2] - contact
        others = row["density"], row["friction"], row["mass_damping"]
        unheld = moved_velocity(dt, force, mass, before, height, *others)
        moved = tuple(jnp.where(free, m, c) for m, c in zip(unheld, carried, strict=True))
        if impulse is not None:
            given = zip(impulse, moved, unheld, strict=True)
            impulse = tuple(i + mass * (m - u) for i, m, u in given)
        placed = tuple(a + dt * b for a, b in zip(here, moved, strict=True))
        return put(x, placed), put(v, moved), hidden, impulse

    hidden = None if inputs.hidden is None else layout.to_cells(inputs.hidden)
    impulse = None
    if inputs.impulse is not None:
        impulse = tuple(inputs.impulse[:, i] for i in range(3))
    start = layout.wide(inputs.x), layout.wide(inputs.v), hidden, impulse
    x, v, hidden, impulse = jax.lax.fori_loop(0, substeps, substep, start)
    hidden = None if hidden is None else layout.from_cells(hidden)
    impulse = None if impulse is None else jnp.stack(impulse, axis=1)
    return jnp.stack(inner(x), axis=1), jnp.stack(inner(v), axis=1), hidden, impulse


def _failure(inputs: Any, results: Any) -> Int[Array, ""]:
    """Inputs that are not finite give `NON_FINITE`, results that are not `TIME_STEP`."""
    code = jnp.where(_all_finite(results), Failure.NONE.value, Failure.TIME_STEP.value)
    return jnp.where(_all_finite(inputs), code, Failure.NON_FINITE.value)


def _all_finite(tree: Any) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


@eqx.filter_jit
def stable_step(
    mesh: Mesh, fabric: Fabric, membrane_damping: Float[Array, ""] | float = MEMBRANE_DAMPING
) -> Float[Array, ""]:
    """The longest substep [s] that is stable for a fabric near its rest shape.

    `membrane_damping`: as in `ExplicitCloth`, [s]. The squares of the highest frequencies of
    membrane and bending have bounds that add. Table and friction do not limit it.
    """
    return longest_step(
        [
            (membrane_frequency(mesh, fabric), jnp.asarray(membrane_damping, float)),
            (bending_frequency(mesh, fabric), fabric.damping),
        ]
    )


def shortest(mesh: Mesh, fabric: Fabric, membrane_damping: Array) -> float:
    """The least `stable_step` [s] of a fabric, or of all members of a batch."""
    limit = stable_step
    for _ in range(jnp.ndim(fabric.density)):
        limit = eqx.filter_vmap(limit, in_axes=(None, 0, None))
    return float(np.min(np.asarray(limit(mesh, fabric, membrane_damping))))


def grid_of(mesh: Mesh) -> tuple[tuple[int, int], tuple[float, float]] | None:
    """Vertices along warp and weft of a `rectangle` of quadrilaterals, and their spacing [m]."""
    corners = np.asarray(mesh.samples.corners)
    if corners.shape[1] != 4:
        return None
    rest = np.asarray(mesh.rest, float)
    columns = int(corners[0, 1] - corners[0, 0])
    shape = len(rest) // columns, columns
    size = rest[-1] - rest[0]
    return shape, (float(size[0]) / (shape[0] - 1), float(size[1]) / (columns - 1))
