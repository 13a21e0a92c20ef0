"""The cloth: a sheet of triangles, implicit in time, second order, differentiable.

A step goes one way: `Cloth.step` sets up the potential of the step (`potential`), Newton's method
minimises it (`newton`) with a sparse factor (`linear`), and where the sheet touches itself that is
repeated with the contacts that it was found to need (`self_contact`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.environment import contact
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.materials.wrinkling import membrane_on_samples, tangents_on_samples
from r2s.mesh.bends import unwrapped
from r2s.mesh.mesh import Mesh
from r2s.mesh.surface import area_normals
from r2s.solvers.contact.contacts import SMALL, SelfContact, colliding, touching
from r2s.solvers.failures import Failure, first_failure, no_failure
from r2s.solvers.implicit.generalised_alpha import by_generalised_alpha, rates_after
from r2s.solvers.implicit.linear.system import Elimination
from r2s.solvers.implicit.newton import minimise
from r2s.solvers.implicit.potential import IncrementalPotential, residual

Positions = Float[Array, "vertex 3"]

MAX_CONTACT_STEP = 1 / 30  # [s]
MAX_ATTEMPTS = 12  # at a step with self-contact, before it fails


class ClothState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `x_before`, `v_before`: those of the step before, which the second-order formula needs.
    - `failure`: the first `r2s.solvers.failures.Failure` of the run so far.
    - `a`, `pull`: accelerations and forces per mass but for the table's, [m/s^2], which the
      generalised-alpha method needs; None of BDF2.
    """

    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    x_before: Float[Array, "vertex 3"]
    v_before: Float[Array, "vertex 3"]
    failure: Int[Array, ""] = eqx.field(default_factory=no_failure)
    a: Float[Array, "vertex 3"] | None = None
    pull: Float[Array, "vertex 3"] | None = None


class Cloth(eqx.Module):
    """A sheet in a scene, stepped by BDF2 or generalised alpha; each step is solved to convergence.

    Differentiable, forward and reverse, in fabric, state, control and scene. `make` makes one.

    - `scene`: sheet, held vertices, table, air.
    - `elimination`: how the linear systems of its mesh are solved.
    - `dt`: step, [s].
    - `self_contact`: how the sheet finds contacts with itself; None: it passes through itself.
    - `tolerance`: the solve ends when no coordinate changes by more, [m]. None: `loss_tolerance` in
      float32, 1e-11 in float64.
    - `max_iterations`: of Newton's method; a step that needs more fails.
    - `spectral_radius`: of the generalised-alpha method (`generalised_alpha`), from 0 to
      below 1: what a step leaves of the fastest vibrations. None: BDF2, which leaves nothing.
    """

    scene: Scene
    elimination: Elimination
    dt: float = eqx.field(static=True)
    self_contact: SelfContact | None = None
    tolerance: float | None = eqx.field(static=True, default=None)
    max_iterations: int = eqx.field(static=True, default=200)
    spectral_radius: float | None = eqx.field(static=True, default=None)

    @classmethod
    def make(
        cls,
        scene: Scene,
        dt: float,
        *,
        self_contact: bool = False,
        tolerance: float | None = None,
        max_iterations: int = 200,
        spectral_radius: float | None = None,
    ) -> "Cloth":
        """A cloth solver for a scene, whose table and air may be traced, but not its mesh.

        Raises `ValueError` for a step that is not positive, or too long for self-contact, for a
        spectral radius beyond its limits, and for one with self-contact.
        """
        elimination, search = prepare_mesh(scene.mesh, self_contact)
        return cls(scene, elimination, dt, search, tolerance, max_iterations, spectral_radius)

    def __check_init__(self):
        if not self.dt > 0:
            raise ValueError(f"dt must be positive, got {self.dt} s")
        if self.self_contact is not None and self.dt > MAX_CONTACT_STEP:
            raise ValueError(
                f"with self-contact dt must be at most {MAX_CONTACT_STEP:.4f} s, since contacts "
                f"are planes that stand still in a step; got {self.dt} s"
            )
        if self.spectral_radius is None:
            return
        if not 0 <= self.spectral_radius < 1:
            raise ValueError(
                f"spectral_radius must be from 0 to below 1, got {self.spectral_radius}"
            )
        if self.self_contact is not None:
            raise ValueError("self-contact goes with BDF2 only: leave spectral_radius at None")

    def init(
        self, x: Positions, v: Positions | None = None, acceleration: Positions | None = None
    ) -> ClothState:
        """A state from positions [m], velocities [m/s], accelerations [m/s^2] (default: zero).

        The acceleration extrapolates the step before; with a wrong one the velocity lags by half a
        step's change, once and for all.
        """
        v = jnp.zeros_like(x) if v is None else v
        a = jnp.zeros_like(x) if acceleration is None else acceleration
        before = x - self.dt * v + self.dt**2 / 2 * a, v - self.dt * a
        forces = (None, None) if self.spectral_radius is None else (a, a)
        return ClothState(x, v, *before, no_failure(), *forces)

    def check(self, fabric: Fabric) -> None:
        """Implicit steps are stable for any fabric."""

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Implicit steps are stable for any fabric."""
        return jnp.ones((), bool)

    def step_with_forces(
        self, fabric: Fabric, state: ClothState, control: Control
    ) -> tuple[ClothState, Float[Array, "handle 3"]]:
        """The state `dt` later, and the grippers' forces [N] on the held vertices, without those
        of self-contact.
        """
        after = self.step(fabric, state, control)
        forces = residual(self.potential(fabric, state, control), after.x)
        return after, forces[self.scene.held]

    def step(self, fabric: Fabric, state: ClothState, control: Control) -> ClothState:
        """The state `dt` later, with the held vertices at `control.handles`."""
        step = self.potential(fabric, state, control)
        ahead = self.dt * (3 * state.v - state.v_before) / 2  # the mean rate, second order
        guess = self.scene.place(state.x + ahead, control.handles)
        solve = self._minimise if self.self_contact is None else self._minimise_with_contacts
        x, failure = solve(step, state.x, guess)
        failure = first_failure(state.failure, failure)
        if self.spectral_radius is None:
            v, forces = step.rate * (x - step.x_anchor), ()
        else:
            v, *forces = rates_after(step, state, x, self.dt, self.spectral_radius)
        return ClothState(x, v, state.x, state.v, failure, *forces)

    def potential(
        self, fabric: Fabric, state: ClothState, control: Control
    ) -> IncrementalPotential:
        """What this step minimises, without self-contact.

        Raises `ValueError` for a state of BDF2 in steps by the generalised-alpha method.
        """
        step = self._by_bdf2(fabric, state, control)
        if self.spectral_radius is None:
            return step
        if state.a is None or state.pull is None:
            raise ValueError("the state has no accelerations: begin with this solver's `init`")
        return by_generalised_alpha(step, state, self.dt, self.spectral_radius)

    def _by_bdf2(self, fabric: Fabric, state: ClothState, control: Control) -> IncrementalPotential:
        """By 2 dt v' = 3 x' - 4 x + x_before, and likewise for all rates."""
        mesh, rate = self.scene.mesh, jnp.asarray(1.5 / self.dt, float)
        depth = self.scene.table.depth(state.x, fabric.thickness)
        bends = fabric.bending.bends(mesh)
        angles = bends.angles(state.x)
        angles_before = unwrapped(bends.angles(state.x_before), angles)
        strain, strain_before = (mesh.samples.strains(x) for x in (state.x, state.x_before))
        strain_anchor = _anchor(strain, strain_before)
        membrane = membrane_on_samples(
            mesh.samples, fabric.membrane, fabric.bending, _extrapolated(strain, strain_before)
        )
        bent = bends.curvatures(_extrapolated(angles, angles_before))
        return IncrementalPotential(
            mesh=mesh,
            fabric=fabric,
            membrane=membrane,
            membrane_tangent=tangents_on_samples(membrane, strain_anchor),
            bending=fabric.bending.on_elements(mesh, bent),
            air=self.scene.air,
            table=self.scene.table,
            rate=rate,
            inertia=rate**2,
            contact_weight=jnp.asarray(1, float),
            x_anchor=_anchor(state.x, state.x_before),
            v_anchor=_anchor(state.v, state.v_before),
            strain_anchor=strain_anchor,
            curvature_anchor=bends.curvatures(_anchor(angles, angles_before)),
            angles=angles,
            area_normals=area_normals(mesh, state.x),
            friction_limit=fabric.friction * mesh.vertex_area * contact.pressure(depth),
            wind=self.scene.wind_on_elements(_extrapolated(state.x, state.x_before), control.wind),
            elimination=self.elimination,
        )

    def _minimise(self, step: IncrementalPotential, before: Positions, guess: Positions):
        del before
        single = loss_tolerance(self.dt)
        tolerance = self.tolerance or (1e-11 if guess.dtype == jnp.float64 else single)
        return minimise(step, guess, self.scene.is_free, tolerance, self.max_iterations)

    def _minimise_with_contacts(
        self, step: IncrementalPotential, before: Positions, guess: Positions
    ):
        """The end of a step from `before` in which the sheet does not pass through itself.

        The step is solved, with the contacts known so far, until its motion lacks none.
        """
        search, mesh, fabric = self.self_contact, self.scene.mesh, step.fabric
        assert search is not None

        def attempt(state):
            x, contacts, _, failure = state
            x, newton = self._minimise(dataclasses.replace(step, contacts=contacts), before, x)
            contacts, is_free, fits = colliding(search, mesh, fabric.thickness, before, x, contacts)
            full = jnp.where(fits, Failure.NONE.value, Failure.SELF_CONTACT.value)
            return x, contacts, is_free, first_failure(first_failure(failure, newton), full)

        def body(state, _):
            is_done = state[2] | (state[3] != Failure.NONE.value)
            return jax.lax.cond(is_done, lambda: state, lambda: attempt(state)), None

        contacts, fits = touching(search, mesh, fabric.thickness, fabric.friction, before)
        failure = jnp.where(fits, Failure.NONE.value, Failure.SELF_CONTACT.value).astype(int)
        begin = guess, contacts, jnp.zeros((), bool), failure
        (x, _, is_free, failure), _ = jax.lax.scan(body, begin, length=MAX_ATTEMPTS)
        unresolved = jnp.where(is_free, Failure.NONE.value, Failure.SELF_CONTACT.value)
        failure = first_failure(failure, unresolved)
        return jnp.where(failure == Failure.NONE.value, x, jnp.nan), failure


def prepare_mesh(mesh: Mesh, self_contact: bool) -> tuple[Elimination, SelfContact | None]:
    """What a cloth solver makes of a mesh, once; it must not be traced."""
    couples_all = self_contact and mesh.rest.shape[0] <= SMALL
    with jax.ensure_compile_time_eval():  # sizes follow from the mesh, also under `jax.jit`
        search = SelfContact.make(mesh) if self_contact else None
        return Elimination.make(mesh, couples_all), search


def loss_tolerance(dt: float) -> float:
    """The tolerance [m] of a step [s] whose errors are lost in those of mesh and time step.

    1e-5 m at 1/60 s and above, shrinking with the square of the step as the formula's error does,
    down to 1e-6 m, near the rounding.
    """
    return min(max(1e-5 * (60 * dt) ** 2, 1e-6), 1e-5)


def _anchor(now: Array, before: Array) -> Array:
    """What the rate of BDF2 is taken from."""
    return (4 * now - before) / 3


def _extrapolated(now: Array, before: Array) -> Array:
    """A step ahead, second order like the formula."""
    return 2 * now - before
