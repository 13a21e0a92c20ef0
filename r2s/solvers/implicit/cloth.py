"""The cloth: a sheet of triangles, implicit in time, second order, differentiable.

`ImplicitCloth.step` sets up the potential of the step (`potential`), Newton's method minimises it
(`newton`) with a sparse factor (`system`), and where the sheet touches itself that is repeated with
the contacts that it was found to need (`r2s.solvers.contact`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.checks import check_kinds
from r2s._util.units import positive
from r2s.environment import contact
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric, check_fabric
from r2s.materials.wrinkling import membrane_on_samples, tangents_on_samples
from r2s.mesh.bends import unwrapped
from r2s.mesh.mesh import Mesh
from r2s.mesh.surface import area_normals
from r2s.solvers.contact.contacts import SMALL, SelfContact, colliding, touching
from r2s.solvers.implicit.generalised_alpha import by_generalised_alpha, rates_after
from r2s.solvers.implicit.newton import minimise
from r2s.solvers.implicit.potential import IncrementalPotential, residual
from r2s.solvers.implicit.system import Elimination
from r2s.solvers.results import LONGEST, Result, check_step_arguments, first_failure, no_failure

Positions = Float[Array, "vertex 3"]

MAX_CONTACT_STEP = 1 / 30  # [s]
MAX_ITERATIONS = 200  # of Newton's method
MAX_ATTEMPTS = 12  # at a step with self-contact, before it fails


class ImplicitState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `x_before`, `v_before`: those of the step before, for the second-order formula.
    - `failure`: the first `r2s.solvers.results.Result` of the run so far.
    - `a`, `pull`: accelerations and forces per mass but for the table's, [m/s^2], which the
      generalised-alpha method needs; None of BDF2.
    """

    x: Positions
    v: Positions
    x_before: Positions
    v_before: Positions
    failure: Int[Array, ""] = eqx.field(default_factory=no_failure)
    a: Positions | None = None
    pull: Positions | None = None


class ImplicitCloth(eqx.Module):
    """A sheet in a scene, stepped by BDF2 or generalised alpha; each step is solved to convergence.

    Differentiable, forward and reverse, in fabric, state, control, scene and step.

    - `scene`: sheet, pinned vertices, table, air, gravity. All may be traced but the mesh.
    - `dt`: step, [s].
    - `self_contact`: True: the sheet does not pass through itself; in the solver, how it finds
      contacts with itself.
    - `tolerance`: the solve ends when no coordinate changes by more, [m]. None: `loss_tolerance` in
      float32, 1e-11 in float64.
    - `max_iterations`: of Newton's method; a step that needs more fails.
    - `spectral_radius`: of the generalised-alpha method (`generalised_alpha`), from 0 to
      below 1: what a step leaves of the fastest vibrations. None: BDF2, which leaves nothing.
    - `elimination`: how the linear systems of the mesh are solved; None: it is worked out, as are
      contacts, by `prepare_mesh`, for which the mesh must not be traced.

    Raises `ValueError` for a step that is not positive, or too long for self-contact, for a
    spectral radius beyond its limits, and for one with self-contact.
    """

    scene: Scene
    dt: Float[Array, ""]
    elimination: Elimination
    self_contact: SelfContact | None
    tolerance: float | None = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)
    spectral_radius: float | None = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        dt: Float[Array, ""] | float,
        *,
        self_contact: SelfContact | bool | None = None,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        spectral_radius: float | None = None,
        elimination: Elimination | None = None,
    ) -> None:
        check_kinds("ImplicitCloth(scene, dt)", scene=(scene, Scene))
        if not is_traced(dt):
            positive("s", dt=float(dt))
            if float(dt) > LONGEST:
                raise ValueError(f"dt is a time step in seconds, at most {LONGEST}, got {dt}")
        self.scene, self.dt = scene, jnp.asarray(dt, float)
        search = None if isinstance(self_contact, bool) else self_contact
        if elimination is None:
            elimination, search = prepare_mesh(scene.mesh, bool(self_contact))
        self.elimination, self.self_contact = elimination, search
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.spectral_radius = spectral_radius
        if search is not None and not is_traced(dt) and float(dt) > MAX_CONTACT_STEP:
            raise ValueError(
                f"with self-contact dt must be at most {MAX_CONTACT_STEP:.4f} s, since contacts "
                f"are planes that stand still in a step; got {dt} s"
            )
        if spectral_radius is not None and not 0 <= spectral_radius < 1:
            raise ValueError(f"spectral_radius must be from 0 to below 1, got {spectral_radius}")
        if search is not None and spectral_radius is not None:
            raise ValueError("self-contact needs BDF2: leave spectral_radius at None")

    def init(
        self, x: Positions, v: Positions | None = None, acceleration: Positions | None = None
    ) -> ImplicitState:
        """A state from positions [m], velocities [m/s], accelerations [m/s^2] (default: zero).

        The acceleration extrapolates the step before; with a wrong one the velocity lags by half a
        step's change, once and for all.
        """
        x, v, a = self.scene.starting(x, v, acceleration)
        before = x - self.dt * v + self.dt**2 / 2 * a, v - self.dt * a
        forces = (None, None) if self.spectral_radius is None else (a, a)
        return ImplicitState(x, v, *before, no_failure(), *forces)

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` for a fabric that has a negative stiffness, or the like."""
        check_fabric(fabric)

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Implicit steps are stable for any fabric."""
        return jnp.ones((), bool)

    def step_with_forces(
        self, fabric: Fabric, state: ImplicitState, control: Control
    ) -> tuple[ImplicitState, Float[Array, "pinned 3"]]:
        """The state `dt` later, and the grippers' forces [N] on the pinned vertices, without those
        of self-contact.
        """
        after = self.step(fabric, state, control)
        forces = residual(self.potential(fabric, state, control), after.x)
        return after, forces[self.scene.pinned]

    def step(self, fabric: Fabric, state: ImplicitState, control: Control) -> ImplicitState:
        """The state `dt` later, with the pinned vertices at `control.pinned`."""
        check_step_arguments(self.scene, fabric, state, control, ImplicitState)
        step = self.potential(fabric, state, control)
        ahead = self.dt * (3 * state.v - state.v_before) / 2  # the mean rate, second order
        guess = self.scene.place(state.x + ahead, control.pinned)
        if self.self_contact is None:
            x, failure = self._minimise(step, guess)
        else:
            x, failure = self._minimise_with_contacts(self.self_contact, step, state.x, guess)
        failure = first_failure(state.failure, failure)
        if self.spectral_radius is None:
            v, forces = step.rate * (x - step.x_anchor), ()
        else:
            v, *forces = rates_after(step, state, x, self.dt, self.spectral_radius)
        return ImplicitState(x, v, state.x, state.v, failure, *forces)

    def potential(
        self, fabric: Fabric, state: ImplicitState, control: Control
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

    def _by_bdf2(
        self, fabric: Fabric, state: ImplicitState, control: Control
    ) -> IncrementalPotential:
        """By 2 dt v' = 3 x' - 4 x + x_before, and likewise for all rates."""
        mesh, rate = self.scene.mesh, jnp.asarray(1.5 / self.dt, float)
        depth = self.scene.table.depth(state.x, fabric.thickness)
        bends = fabric.bending.bends(mesh)
        angles = bends.angles(state.x)
        angles_before = unwrapped(bends.angles(state.x_before), angles)
        strain, strain_before = (mesh.samples.strains(x) for x in (state.x, state.x_before))
        strain_anchor = _anchor(strain, strain_before)
        ahead = _extrapolated(strain, strain_before)
        membrane = membrane_on_samples(mesh.samples, fabric.membrane, fabric.bending, ahead)
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
            gravity=self.scene.gravity,
            elimination=self.elimination,
        )

    def _minimise(self, step: IncrementalPotential, guess: Positions):
        usual = 1e-11 if guess.dtype == jnp.float64 else loss_tolerance(self.dt)
        tolerance = usual if self.tolerance is None else self.tolerance
        return minimise(step, guess, self.scene.is_free, tolerance, self.max_iterations)

    def _minimise_with_contacts(
        self, search: SelfContact, step: IncrementalPotential, before: Positions, guess: Positions
    ):
        """The end of a step from `before` in which the sheet does not pass through itself.

        The step is solved, with the contacts known so far, until its motion lacks none.
        """
        mesh, fabric = self.scene.mesh, step.fabric

        def unless(fine):
            return jnp.where(fine, Result.SUCCESS.value, Result.SELF_CONTACT.value).astype(int)

        def attempt(state):
            x, contacts, _, failure = state
            x, newton = self._minimise(dataclasses.replace(step, contacts=contacts), x)
            contacts, is_free, fits = colliding(search, mesh, fabric.thickness, before, x, contacts)
            failure = first_failure(first_failure(failure, newton), unless(fits))
            return x, contacts, is_free, failure

        def body(state, _):
            is_done = state[2] | (state[3] != Result.SUCCESS.value)
            return jax.lax.cond(is_done, lambda: state, lambda: attempt(state)), None

        contacts, fits = touching(search, mesh, fabric.thickness, fabric.friction, before)
        begin = guess, contacts, jnp.zeros((), bool), unless(fits)
        (x, _, is_free, failure), _ = jax.lax.scan(body, begin, length=MAX_ATTEMPTS)
        failure = first_failure(failure, unless(is_free))
        return jnp.where(failure == Result.SUCCESS.value, x, jnp.nan), failure


def prepare_mesh(mesh: Mesh, self_contact: bool) -> tuple[Elimination, SelfContact | None]:
    """What a cloth solver makes of a mesh, once; it must not be traced."""
    couples_all = self_contact and mesh.rest.shape[0] <= SMALL
    with jax.ensure_compile_time_eval():  # sizes follow from the mesh, also under `jax.jit`
        search = SelfContact.make(mesh) if self_contact else None
        return Elimination.make(mesh, couples_all), search


def loss_tolerance(dt: Float[Array, ""] | float) -> Float[Array, ""]:
    """The tolerance [m] of a step [s] whose errors are lost in those of mesh and time step.

    1e-5 m at 1/60 s and above, shrinking with the square of the step as the formula's error does,
    down to 1e-6 m, near the rounding.
    """
    return jnp.clip(1e-5 * (60 * jnp.asarray(dt, float)) ** 2, 1e-6, 1e-5)


def _anchor(now: Array, before: Array) -> Array:
    """What the rate of BDF2 is taken from."""
    return (4 * now - before) / 3


def _extrapolated(now: Array, before: Array) -> Array:
    """A step ahead, second order like the formula."""
    return 2 * now - before
