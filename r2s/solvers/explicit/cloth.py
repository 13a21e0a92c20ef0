"""The cloth in explicit steps: as many symplectic substeps in a step as its waves need.

The physics are those of `r2s.ImplicitCloth`, but for the fastest waves of the membrane
(`stability.Viscosity`). A substep needs no solve, and all its arrays are worked on side by side:
of a batch, its members. For derivatives the implicit cloth is better: these would go through every
substep.
"""

import math
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.checks import check_kinds
from r2s._util.units import Scalar
from r2s.environment.contact import PRESSURE_STIFFNESS, SLIP_SPEED
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric, check_fabric
from r2s.mesh.vectors import Vector, add, columns, scale, subtract
from r2s.solvers.explicit.grid import Slices, grid_for
from r2s.solvers.explicit.layout import batch_last
from r2s.solvers.explicit.sheet import Cells, ForceInputs, Gathers, Memory, cells_of, no_memory
from r2s.solvers.explicit.stability import RELAXATION, check_step, stable_sheet_step
from r2s.solvers.results import Result, all_finite, check_step_arguments, first_failure, no_failure

Positions = Float[Array, "vertex 3"]
OfSamples = Float[Array, "element sample 3"]

ROUNDING = 1e-3  # of a limit in float32
SOLVES = 3  # of Newton's method for the slip, which comes from below, within 1 % of it
TRACED = (
    "the fabric that gives the substeps must not be traced: make the solver outside of jit, grad "
    "and vmap, of the stiffest fabric, and trace its steps"
)
REFUSED = (
    "explicit steps have no contact of the sheet with itself: take the implicit cloth, "
    "r2s.ImplicitCloth(..., self_contact=True), or material points, r2s.mpm_cloth"
)


class ExplicitState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `relaxed`: stress of every sample that its viscosity remembers, [N/m].
    - `hidden`: scaled wrinkles of every sample, near which the next substep finds its own; None:
      the mesh has none, or is no grid.
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
      fewest below `stable_sheet_step`.
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
        check_kinds("ExplicitCloth(scene, dt, fabric)", scene=(scene, Scene))
        if fabric is not None:
            check_kinds("ExplicitCloth(scene, dt, fabric)", fabric=(fabric, Fabric))
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
        longest = self._longest_substep(fabric)
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
        self._check_substep(self._longest_substep(fabric))

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Whether the substeps are short enough for a fabric, which may be traced."""
        longest = stable_sheet_step(self.scene.mesh, fabric, self.membrane_damping, self.relaxation)
        return self.dt / self.substeps <= (1 + ROUNDING) * longest

    def _longest_substep(self, fabric: Fabric) -> float:
        """The least `stable_sheet_step` [s] of a fabric, or of all members of a batch."""
        limit = stable_sheet_step
        for _ in range(jnp.ndim(fabric.density)):
            limit = eqx.filter_vmap(limit, in_axes=(None, 0, None, None))
        with jax.ensure_compile_time_eval():
            limits = limit(self.scene.mesh, fabric, self.membrane_damping, self.relaxation)
            return float(np.min(np.asarray(limits)))

    def _check_substep(self, longest: float) -> None:
        material = f"the fabric and the mesh (dt = {self.dt:g} s in {self.substeps} substeps)"
        check_step(self.dt / self.substeps, jnp.asarray(longest), material)

    def init(
        self, x: Positions, v: Positions | None = None, acceleration: Positions | None = None
    ) -> ExplicitState:
        """A state from positions [m] and velocities [m/s] (default: zero).

        The `acceleration` is not used.
        """
        x, v, _ = self.scene.starting(x, v, acceleration)
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
        substep = jnp.asarray(self.dt / self.substeps, dtype)
        memory = Memory(state.relaxed, state.hidden, state.begun)
        inputs = _Inputs(
            ForceInputs.make(self, fabric, state, control.wind, memory, substep),
            carried,
            scene.is_free.astype(dtype),
            scene.table.height,
            scene.gravity,
            substep,
            jnp.zeros_like(state.x) if with_impulse else None,
        )
        grid = grid_for(self.grid, fabric)
        if grid is None:
            moved = self._advance(Gathers(scene.mesh), inputs)
        else:
            moved = batch_last(lambda batched, x: self._advance(Slices(*grid, batched), x), inputs)
        x = scene.place(moved.x, control.pinned)
        failure = _failure((state.x, state.v, fabric, control), (x, moved.v))
        failure = first_failure(state.failure, failure)
        relaxed, hidden, begun = moved.memory
        return ExplicitState(x, moved.v, relaxed, hidden, begun, failure), moved.impulse

    def _advance(self, layout: Slices | Gathers, inputs: "_Inputs") -> "_Moving":
        """What the substeps of a step change; of a batch as the last axis on a grid."""
        start, fabric = inputs.forces, inputs.forces.fabric
        force_of, memory = layout.forces(start)
        dt, gravity = layout.row(inputs.substep), layout.row(inputs.gravity)
        density, friction, mass_damping, thickness = (
            layout.row(number)
            for number in (fabric.density, fabric.friction, fabric.mass_damping, fabric.thickness)
        )
        others = density, friction, mass_damping, gravity
        mass = density * layout.areas(start.x)
        contact = layout.row(inputs.table_height) + thickness
        free, carried = inputs.is_free > 0, columns(inputs.carried)

        def substep(_, moving: _Moving) -> _Moving:
            force, memory = force_of(moving.x, moving.v, moving.memory)
            x, v, impulse = layout.inner(moving.x), layout.inner(moving.v), moving.impulse
            unheld = moved_velocity(dt, force, mass, v, x[2] - contact, *others)
            pairs = zip(unheld, carried, strict=True)
            along, across, up = (jnp.where(free, own, given) for own, given in pairs)
            moved = along, across, up
            if impulse is not None:
                impulse = add(impulse, scale(mass, subtract(moved, unheld)))
            placed = add(x, scale(dt, moved))
            wide = layout.put(moving.x, placed), layout.put(moving.v, moved)
            return _Moving(*wide, memory, impulse)

        impulse = None if inputs.impulse is None else columns(inputs.impulse)
        moving = _Moving(layout.wide(start.x), layout.wide(start.v), memory, impulse)
        x, v, memory, impulse = jax.lax.fori_loop(0, self.substeps, substep, moving)
        impulse = None if impulse is None else jnp.stack(impulse, axis=1)
        x, v = (jnp.stack(layout.inner(wide), axis=1) for wide in (x, v))
        return _Moving(x, v, layout.remembered(memory), impulse)


class _Moving(NamedTuple):
    """What a substep changes; on a grid with room on either side (`Layout`)."""

    x: Any
    v: Any
    memory: Memory
    impulse: Any  # [N s], of the grippers, added up; None: it is not asked for


class _Inputs(NamedTuple):
    """All that a step depends on; of a batch as the last axis on a grid."""

    forces: ForceInputs
    carried: Array  # velocities of pinned vertices
    is_free: Array
    table_height: Array
    gravity: Array
    substep: Array  # [s]
    impulse: Array | None


def _failure(inputs: Any, results: Any) -> Int[Array, ""]:
    """Inputs that are not finite give `NON_FINITE`, results that are not `TIME_STEP`."""
    code = jnp.where(all_finite(results), Result.SUCCESS.value, Result.TIME_STEP.value)
    return jnp.where(all_finite(inputs), code, Result.NON_FINITE.value)


def moved_velocity(
    dt: Array,
    force: Vector,
    mass: Array,
    v: Vector,
    height: Array,
    density: Array,
    friction: Array,
    mass_damping: Array,
    gravity: Array,
) -> Vector:
    """Velocities [m/s] at the end of a substep `dt` [s].

    - `force`: all but those below, [N]; `mass`: [kg]; `v`: velocities before, [m/s].
    - `height`: above the place where contact with the table begins, [m].
    - `density` [kg/m^2], `friction` [-], `mass_damping` [1/s]: of the fabric.
    - `gravity`: downwards, [m/s^2].
    """
    braking = 1 / (1 + dt * mass_damping)
    along, across, up = (braking * (u + dt * f / mass) for u, f in zip(v, force, strict=True))
    up = up - braking * dt * gravity
    # depth = free depth - dt^2 PRESSURE_STIFFNESS / density * depth^2
    free = jnp.maximum(-height - dt * up, 0)
    stiff = braking * dt**2 * PRESSURE_STIFFNESS / density
    depth = 2 * free / (1 + jnp.sqrt(1 + 4 * stiff * free))
    pushed = braking * dt * PRESSURE_STIFFNESS / density * depth**2
    # a root that has a derivative where nothing slides
    speed = jnp.sqrt(along**2 + across**2 + jnp.finfo(along.dtype).tiny)
    kept = _kept_slip(speed, friction * pushed)
    return kept * along, kept * across, up + pushed


def _kept_slip(speed: Array, loss: Array) -> Array:
    """The fraction of a sliding speed [m/s] that friction leaves, of which it can take `loss`.

    With r the speed that is left, r + loss r / sqrt(r^2 + SLIP_SPEED^2) = speed.
    """
    left = jnp.maximum(speed - loss, speed * SLIP_SPEED / (SLIP_SPEED + loss))
    for _ in range(SOLVES):
        squared = left**2 + SLIP_SPEED**2
        share = loss / jnp.sqrt(squared)
        off = left * (1 + share) - speed
        left = left - off / (1 + share * SLIP_SPEED**2 / squared)
    return left / speed
