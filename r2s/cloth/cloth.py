"""The cloth: a sheet of triangles, implicit in time, second order, differentiable."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.cloth.newton import minimise
from r2s.cloth.potential import (
    IncrementalPotential,
    bending_laws,
    curvatures,
    hinge_angles,
    strains,
)
from r2s.cloth.self_contact.contacts import Contacts, resolve_contacts
from r2s.fabrics.fabric import Fabric
from r2s.geometry.mesh import Mesh
from r2s.laws.bending import unwrapped
from r2s.world import contact
from r2s.world.scene import Control, Scene

Positions = Float[Array, "vertex 3"]

MAX_CONTACT_STEP = 1 / 30  # [s]


class ClothState(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s], world frame, z up.
    - `x_before`, `v_before`: those of the step before, which the second-order formula needs.
    """

    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    x_before: Float[Array, "vertex 3"]
    v_before: Float[Array, "vertex 3"]


class Cloth(eqx.Module):
    """A sheet in a scene, stepped by BDF2; every step is solved to convergence.

    Differentiable, forward and reverse, in fabric, state, control and scene.

    - `scene`: sheet, held vertices, table, air.
    - `dt`: step, [s].
    - `tolerance`: the solve ends when no coordinate changes by more, [m]. None: 1e-6 in float32,
      1e-11 in float64.
    - `max_iterations`: of Newton's method; a step that needs more is NaN.
    """

    scene: Scene
    dt: float = eqx.field(static=True)
    tolerance: float | None = eqx.field(static=True, default=None)
    max_iterations: int = eqx.field(static=True, default=200)

    def __check_init__(self):
        if not self.dt > 0:
            raise ValueError(f"dt must be positive, got {self.dt} s")
        if self.scene.layers is not None and self.dt > MAX_CONTACT_STEP:
            raise ValueError(
                f"with contact between layers dt must be at most {MAX_CONTACT_STEP:.4f} s, since "
                f"contacts are planes that stand still in a step; got {self.dt} s"
            )

    def init(
        self, x: Positions, v: Positions | None = None, acceleration: Positions | None = None
    ) -> ClothState:
        """A state from positions [m], velocities [m/s], accelerations [m/s^2] (default: zero).

        The acceleration makes up the step before. The motion is second order in `dt` when it is
        right: zero for a sheet that starts in equilibrium. Otherwise the velocity lags by half a
        step's change, once and for all.
        """
        v = jnp.zeros_like(x) if v is None else v
        a = jnp.zeros_like(x) if acceleration is None else acceleration
        return ClothState(x, v, x - self.dt * v + self.dt**2 / 2 * a, v - self.dt * a)

    def step(self, fabric: Fabric, state: ClothState, control: Control) -> ClothState:
        """The state `dt` later, with the held vertices at `control.handles`."""
        increment = self.increment(fabric, state, control)
        guess = self.scene.place(state.x + self.dt * state.v, control.handles)
        tolerance = self.tolerance or (1e-11 if guess.dtype == jnp.float64 else 1e-6)
        free = self.scene.is_free

        def solve(contacts: Contacts | None, guess: Positions) -> Positions:
            touched = dataclasses.replace(increment, contacts=contacts)
            return minimise(touched, guess, free, tolerance, self.max_iterations)

        if self.scene.layers is None:
            x = solve(None, guess)
        else:
            about = self.scene.mesh, fabric.thickness, fabric.friction
            x = resolve_contacts(self.scene.layers, *about, state.x, guess, solve)
        v = increment.rate * (x - increment.x_anchor)
        return ClothState(x, v, state.x, state.v)

    def increment(
        self, fabric: Fabric, state: ClothState, control: Control
    ) -> IncrementalPotential:
        """What this step's potential depends on. BDF2: 2 dt v' = 3 x' - 4 x + x_before."""
        mesh = self.scene.mesh
        depth = self.scene.table.depth(state.x, fabric.thickness)
        bdf2 = lambda now, before: (4 * now - before) / 3
        angles = hinge_angles(mesh, state.x)
        angles_before = unwrapped(hinge_angles(mesh, state.x_before), angles)
        strain, strain_before = strains(mesh, state.x), strains(mesh, state.x_before)
        ahead = lambda now, before: 2 * now - before  # second order, like the formula
        hinges = curvatures(mesh, ahead(angles, angles_before))
        return IncrementalPotential(
            mesh=mesh,
            fabric=fabric,
            membrane=jax.vmap(fabric.membrane.at)(ahead(strain, strain_before)),
            bending=bending_laws(mesh, fabric.bending, hinges),
            air=self.scene.air,
            table=self.scene.table,
            rate=jnp.asarray(1.5 / self.dt, float),
            x_anchor=bdf2(state.x, state.x_before),
            v_anchor=bdf2(state.v, state.v_before),
            strain_anchor=bdf2(strain, strain_before),
            curvature_anchor=curvatures(mesh, bdf2(angles, angles_before)),
            angles=angles,
            area_normals=_area_normals(mesh, state.x),
            friction_limit=fabric.friction * mesh.vertex_area * contact.pressure(depth),
            layers=self.scene.layers,
            wind=self.scene.wind_on_faces(ahead(state.x, state.x_before), control.wind),
        )


def _area_normals(mesh: Mesh, x: Positions) -> Float[Array, "face 3"]:
    """Normals of the faces, as long as their areas, [m^2]."""
    corners = x[mesh.faces]
    return jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
