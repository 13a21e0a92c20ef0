"""The cloth in explicit steps: as many symplectic substeps in a step as its waves need.

The physics are those of `r2s.ImplicitCloth`, but for the fastest waves of the membrane
(`viscosity`). A substep needs no solve, and all its arrays are worked on side by side:
of a batch, its members. For derivatives the implicit cloth is better: these would go through every
substep.
"""

import math
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.units import Scalar
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric, check_fabric
from r2s.materials.plate import PlateLaw
from r2s.mesh.mesh import Mesh
from r2s.solvers.arguments import check_step_arguments
from r2s.solvers.explicit import elements
from r2s.solvers.explicit.elements import moved_velocity
from r2s.solvers.explicit.layout import Layout, batch_last
from r2s.solvers.explicit.sheet import (
    Cells,
    ForceInputs,
    Memory,
    cells_of,
    force_by_gathers,
    no_memory,
    remembered,
    slices,
)
from r2s.solvers.explicit.stability import RELAXATION, Viscosity, check_step, longest_relaxing_step
from r2s.solvers.results import Result, all_finite, first_failure, no_failure

Positions = Float[Array, "vertex 3"]
OfSamples = Float[Array, "element sample 3"]

ROUNDING = 1e-3  # of a limit in float32
TRACED = (
    "the fabric that gives the substeps must not be traced: make the solver outside of jit, grad "
    "and vmap, of the stiffest fabric, and trace its steps"
)
REFUSED = (
    "explicit steps do not know contact of the sheet with itself: take the implicit cloth, "
    "r2s.ImplicitCloth(..., self_contact=True), or material points, r2s.mpm_cloth"
)


class ExplicitState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `relaxed`: stress of every sample that its viscosity remembers, [N/m].
    - `hidden`: scaled wrinkles of every sample, from where the next substep goes on; None: the mesh
      has none, or is no grid.
    - `begun`: whether there was a step.
    - `failure`: the first `r2s.solvers.results.Result` of the run so far.
    """

    x: Positions
    v: Positions
    relaxed: OfSamples
    hidden: OfSamples | None
    begun: Bool[Array, ""]
    failure: Int[Array, ""]


class ExplicitCloth(eqx.Module):
    """A sheet in a scene, stepped by symplectic Euler in substeps.

    `jax.vmap` of `step` runs a batch with its members side by side.

    - `scene`: sheet, pinned vertices, table, air, gravity. Its mesh must not be traced.
    - `dt`: step, [s]; another one is another program.
    - `fabric`: the stiffest that it will be used for, or a batch of all: it gives the substeps, the
      fewest below `stable_step`.
    - `membrane_damping`: damping time of the membrane, [s]; None: the fabric's.
    - `relaxation`: of the membrane's viscosity, [s]; 0 is plain Kelvin-Voigt damping, in far
      shorter substeps.
    - `substeps`: in a step, instead of those of the fabric, which may be None then.
    - `grid`: vertices along warp and weft of a rectangle of quadrilaterals, and the spacing
      between them [m]; None: any other mesh, whose forces take several times as long.

    Raises `ValueError` for a step that is not positive, for substeps that are too long, with their
    limit, for a fabric that is traced or has no limit, and for self-contact.
    """

    scene: Scene
    dt: float = eqx.field(static=True)
    membrane_damping: Float[Array, ""] | None
    relaxation: Float[Array, ""]
    substeps: int = eqx.field(static=True)
    grid: Cells | None = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        dt: float,
        fabric: Fabric | None = None,
        membrane_damping: Scalar | None = None,
        relaxation: Scalar = RELAXATION,
        *,
        substeps: int | None = None,
        grid: Cells | Literal["of the mesh"] | None = "of the mesh",
        self_contact: bool = False,
    ) -> None:
        if self_contact:
            raise ValueError(REFUSED)
        if is_traced(fabric):
            raise ValueError(TRACED)
        if substeps is not None and (substeps != int(substeps) or substeps < 1):
            raise ValueError(f"substeps must be a whole number from 1 on, got {substeps}")
        dt = float(dt)
        if not (math.inf > dt > 0 and relaxation >= 0 and (membrane_damping or 0) >= 0):
            raise ValueError(
                "dt must be positive, damping time and relaxation not negative, got "
                f"{dt} s, {membrane_damping} s and {relaxation} s"
            )
        self.scene, self.dt = scene, dt
        damped = membrane_damping is not None
        self.membrane_damping = jnp.asarray(membrane_damping, float) if damped else None
        self.relaxation = jnp.asarray(relaxation, float)
        with jax.ensure_compile_time_eval():
            self.grid = cells_of(scene.mesh) if grid == "of the mesh" else grid
        if fabric is None:
            if substeps is None:
                raise ValueError("expected a fabric, which gives the substeps, or substeps")
            self.substeps = substeps
            return
        with jax.ensure_compile_time_eval():
            longest = shortest(scene.mesh, fabric, self.membrane_damping, self.relaxation)
        if not 0 < longest < math.inf:
            raise ValueError(
                f"the fabric has no longest substep (found {longest} s): its density and its "
                "stiffness must be positive, its numbers finite"
            )
        self.substeps = substeps or max(1, math.ceil(dt / longest * (1 + 1e-6)))
        self._check_substep(longest)

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` when the substeps are too long for a fabric, unless it is traced."""
        if is_traced(fabric):
            return
        check_fabric(fabric)
        with jax.ensure_compile_time_eval():
            times = self.membrane_damping, self.relaxation
            self._check_substep(shortest(self.scene.mesh, fabric, *times))

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Whether the substeps are short enough for a fabric, which may be traced."""
        longest = stable_step(self.scene.mesh, fabric, self.membrane_damping, self.relaxation)
        return self.dt / self.substeps <= (1 + ROUNDING) * longest

    def _check_substep(self, longest: float) -> None:
        material = f"the fabric and the mesh (dt = {self.dt:g} s in {self.substeps} substeps)"
        check_step(self.dt / self.substeps, jnp.asarray(longest), material)

    def init(
        self, x: Positions, v: Positions | None = None, acceleration: Positions | None = None
    ) -> ExplicitState:
        """A state from positions [m] and velocities [m/s] (default: zero).

        The `acceleration` is not used.
        """
        v = jnp.zeros_like(x) if v is None else v
        return ExplicitState(x, v, *no_memory(self.scene.mesh, self.grid, x.dtype), no_failure())

    def step(self, fabric: Fabric, state: ExplicitState, control: Control) -> ExplicitState:
        """The state `dt` later, with the pinned vertices at `control.pinned`."""
        return self._step(fabric, state, control, False)[0]

    def step_with_forces(
        self, fabric: Fabric, state: ExplicitState, control: Control
    ) -> tuple[ExplicitState, Float[Array, "pinned 3"]]:
        """The state `dt` later, and the grippers' mean forces [N] on the pinned vertices."""
        after, impulse = self._step(fabric, state, control, True)
        return after, impulse[self.scene.pinned] / self.dt

    def _step(self, fabric: Fabric, state: ExplicitState, control: Control, with_impulse: bool):
        check_step_arguments(self.scene, fabric, state, control, ExplicitState)
        scene, dtype = self.scene, state.x.dtype
        carried = jnp.zeros_like(state.x)
        carried = carried.at[scene.pinned].set((control.pinned - state.x[scene.pinned]) / self.dt)
        damping = fabric.damping if self.membrane_damping is None else self.membrane_damping
        substep = jnp.asarray(self.dt / self.substeps, dtype)
        memory = Memory(state.relaxed, state.hidden, state.begun)
        viscosity = Viscosity.make(damping, self.relaxation, substep)
        around = viscosity, scene.air, scene.fan
        wind = jnp.zeros(3, dtype) if control.wind is None else control.wind
        inputs = _Inputs(
            ForceInputs(fabric, *around, state.x, state.v, wind, memory),
            carried,
            scene.is_free.astype(dtype),
            scene.table.height,
            scene.gravity,
            substep,
            jnp.zeros_like(state.x) if with_impulse else None,
        )
        if self.grid is not None and isinstance(fabric.bending, PlateLaw):
            advance = partial(_advance_grid, *self.grid, self.substeps)
            moved = batch_last(advance, inputs)
        else:
            moved = _advance(scene.mesh, self.substeps, inputs)
        x = scene.place(moved.x, control.pinned)
        asked = state.x, state.v, fabric, control
        failure = first_failure(state.failure, _failure(asked, (x, moved.v)))
        relaxed, hidden, begun = moved.memory
        return ExplicitState(x, moved.v, relaxed, hidden, begun, failure), moved.impulse


class _Moving(NamedTuple):
    """What a substep changes; on a grid with room on either side (`Layout`)."""

    x: Any
    v: Any
    memory: Any
    impulse: Any  # [N s], of the grippers, added up; None: it is not asked for


class _Inputs(NamedTuple):
    """All that a step depends on; with a batch as last axis in `_advance_grid`."""

    forces: ForceInputs
    carried: Array  # velocities of pinned vertices
    is_free: Array
    table_height: Array
    gravity: Array
    substep: Array  # [s]
    impulse: Array | None


def _advance(mesh: Mesh, substeps: int, inputs: _Inputs) -> _Moving:
    """What the substeps of a step change, of any mesh."""
    start, fabric = inputs.forces, inputs.forces.fabric
    small = inputs.substep
    mass = fabric.density * mesh.vertex_area
    free, carried = inputs.is_free > 0, tuple(inputs.carried.T)

    def substep(moving: _Moving, _):
        x, v, memory, impulse = moving
        force, memory = force_by_gathers(mesh, start._replace(x=x, v=v, memory=memory))
        height = x[:, 2] - inputs.table_height - fabric.thickness
        others = fabric.density, fabric.friction, fabric.mass_damping, inputs.gravity
        moved = moved_velocity(small, tuple(force.T), mass, tuple(v.T), height, *others)
        v = jnp.stack([jnp.where(free, m, c) for m, c in zip(moved, carried, strict=True)], 1)
        if impulse is not None:
            impulse += mass[:, None] * (v - jnp.stack(moved, axis=1))
        return _Moving(x + small * v, v, memory, impulse), None

    moving = _Moving(start.x, start.v, start.memory, inputs.impulse)
    return jax.lax.scan(substep, moving, length=substeps)[0]


def _advance_grid(shape, spacing, substeps: int, batched: bool, inputs: _Inputs) -> _Moving:
    """What the substeps of a step change, on a grid."""
    layout, start = Layout(shape, spacing, batched), inputs.forces
    force_of, samples = slices(layout, start)
    count, room = layout.count, layout.room
    dt = layout.row(inputs.substep)
    names = ("density", "friction", "mass_damping", "thickness")
    *others, thickness = (layout.row(getattr(start.fabric, name)) for name in names)
    mass = others[0] * layout.constant(layout.vertex_areas, 0, start.x)
    contact = layout.row(inputs.table_height) + thickness
    others.append(layout.row(inputs.gravity))
    free, carried = inputs.is_free > 0, _columns(inputs.carried)

    def inner(arrays):
        return tuple(each[room : room + count] for each in arrays)

    def put(wide, arrays):
        return tuple(w.at[room : room + count].set(a) for w, a in zip(wide, arrays, strict=True))

    def substep(_, moving: _Moving) -> _Moving:
        x, v, (samples, begun), impulse = moving
        force, samples = force_of(x, v, samples, begun)
        here = inner(x)
        unheld = moved_velocity(dt, force, mass, inner(v), here[2] - contact, *others)
        moved = tuple(jnp.where(free, m, c) for m, c in zip(unheld, carried, strict=True))
        if impulse is not None:
            given = zip(impulse, moved, unheld, strict=True)
            impulse = tuple(i + mass * (m - u) for i, m, u in given)
        placed = tuple(a + dt * b for a, b in zip(here, moved, strict=True))
        return _Moving(put(x, placed), put(v, moved), (samples, jnp.ones_like(begun)), impulse)

    impulse = None if inputs.impulse is None else _columns(inputs.impulse)
    memory = samples, layout.row(start.memory.begun)
    moving = _Moving(layout.wide(start.x), layout.wide(start.v), memory, impulse)
    x, v, (samples, begun), impulse = jax.lax.fori_loop(0, substeps, substep, moving)
    memory = remembered(layout, samples, begun[0] if batched else begun)
    impulse = None if impulse is None else jnp.stack(impulse, axis=1)
    return _Moving(jnp.stack(inner(x), axis=1), jnp.stack(inner(v), axis=1), memory, impulse)


def _columns(vectors: Array) -> tuple[Array, Array, Array]:
    return vectors[:, 0], vectors[:, 1], vectors[:, 2]


def _failure(inputs: Any, results: Any) -> Int[Array, ""]:
    """Inputs that are not finite give `NON_FINITE`, results that are not `TIME_STEP`."""
    code = jnp.where(all_finite(results), Result.SUCCESS.value, Result.TIME_STEP.value)
    return jnp.where(all_finite(inputs), code, Result.NON_FINITE.value)


@eqx.filter_jit
def stable_step(
    mesh: Mesh,
    fabric: Fabric,
    membrane_damping: Float[Array, ""] | float | None = None,
    relaxation: Float[Array, ""] | float = RELAXATION,
) -> Float[Array, ""]:
    """The longest substep [s] that is stable for a fabric near its rest shape.

    `membrane_damping`, `relaxation`: as in `ExplicitCloth`, [s]. The squares of the highest
    frequencies of membrane and bending have bounds that add. Table and friction do not limit it.
    """
    damping = fabric.damping if membrane_damping is None else jnp.asarray(membrane_damping, float)
    bending = elements.bending_frequency(mesh, fabric), fabric.damping
    stretching = elements.membrane_frequency(mesh, fabric)
    return longest_relaxing_step(stretching, damping, jnp.asarray(relaxation, float), [bending])


def shortest(mesh: Mesh, fabric: Fabric, damping: Array | None, relaxation: Array) -> float:
    """The least `stable_step` [s] of a fabric, or of all members of a batch."""
    limit = stable_step
    for _ in range(jnp.ndim(fabric.density)):
        limit = eqx.filter_vmap(limit, in_axes=(None, 0, None, None))
    return float(np.min(np.asarray(limit(mesh, fabric, damping, relaxation))))
