"""A sheet of fabric by the material point method: a mesh whose vertices are the particles.

After Jiang, Gast and Teran 2017, whom DiffCP (Zheng et al. 2024) follows. The laws of membrane and
bending, the mesh and the `Fabric` are those of `r2s.ImplicitCloth`. Contact of the sheet with
itself, with the table and with walls comes from the grid: across the sheet its velocity gradient
drives compression and shear between layers (`Transverse`), which stay about a spacing apart.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s._util.checks import check_kinds
from r2s._util.units import Scalar, positive
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric, check_fabric
from r2s.mesh.mesh import Mesh
from r2s.solvers.explicit.grid import sheet_force
from r2s.solvers.explicit.sheet import Cells, ForceInputs, Memory, cells_of, no_memory
from r2s.solvers.explicit.stability import RELAXATION, check_step, stable_sheet_step
from r2s.solvers.mpm.background import Background
from r2s.solvers.mpm.grid import Grid, failure_of_step
from r2s.solvers.mpm.transfer import affine_factor
from r2s.solvers.results import check_step_arguments, first_failure, no_failure

Vector = Float[Array, " 3"]
Vertices = Float[Array, "vertex 3"]

COARSEST = 1.8  # longest edge of a mesh over the grid's spacing, so that layers cannot pass
ONSET = 0.5  # [-]: layers press when they are about a spacing apart
CONTACT = 20.0  # [N/m]: some cm of a fabric's weight press layers together by a tenth
SMOOTHING = 1e-6  # [-]: added to the tilt's norm, which is then differentiable at no tilt


class Transverse(eqx.Module):
    """The stiffnesses of contact between layers (docs/theory.md).

    - `compression`, `shear`: K and G, force per width, [N/m].
    - `onset`: c, [-].
    """

    compression: Float[Array, ""]
    shear: Float[Array, ""]
    onset: Float[Array, ""]

    def energy(self, corners: Float[Array, "3 3"], direction: Vector) -> Float[Array, ""]:
        """Energy per area [J/m^2] of a triangle [m] and its transverse direction [-]."""
        along = direction @ unit_normal(corners)
        tilt = direction @ direction - along**2
        pressed = self.compression / 3 * jnp.maximum(self.onset - along, 0) ** 3
        return pressed + self.shear / 2 * tilt

    def return_mapping(
        self, corners: Float[Array, "3 3"], direction: Vector, friction: Float[Array, ""]
    ) -> Vector:
        """The transverse direction [-] that friction and separation leave."""
        normal = unit_normal(corners)
        along = direction @ normal
        tilt = direction - along * normal
        along = jnp.minimum(along, 1)
        limit = friction * self.compression * jnp.maximum(self.onset - along, 0) ** 2 / self.shear
        size = jnp.sqrt(tilt @ tilt + SMOOTHING**2)
        return along * normal + jnp.minimum(limit / size, 1) * tilt

    def stress(
        self, corners: Float[Array, "3 3"], direction: Vector
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Forces on the corners per rest area [Pa], and the Kirchhoff stress times the thickness
        [N/m] for the grid. Together they exert no torque.
        """
        in_corners, in_direction = jax.grad(self.energy, argnums=(0, 1))(corners, direction)
        return -in_corners, in_direction[:, None] * direction[None]

    def frequency(self, density: Float[Array, ""], spacing: float) -> Float[Array, ""]:
        """A bound on the square of the highest frequency [1/s^2] on a grid, for d >= 1/2.

        `density` is areal [kg/m^2], `spacing` that of the grid [m]; see `block.stable_step`.
        """
        return 4 * jnp.maximum(self.compression, self.shear) / (density * spacing**2)


def unit_normal(corners: Float[Array, "3 3"]) -> Vector:
    """The unit normal of a triangle [-]."""
    normal = jnp.cross(corners[1] - corners[0], corners[2] - corners[0])
    return normal / jnp.sqrt(normal @ normal)


class MPMState(eqx.Module):
    """A sheet at one time.

    - `x`, `v`: positions [m] and velocities [m/s] of the vertices.
    - `C`: affine velocity matrices of the vertices, [1/s].
    - `d`: transverse directions of the faces, [-].
    - `memory`: of the membrane's samples.
    - `failure`: the first `r2s.solvers.results.Result` of the run so far.
    """

    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    C: Float[Array, "vertex 3 3"]
    d: Float[Array, "face 3"]
    memory: Memory
    failure: Int[Array, ""]


class MPMCloth(eqx.Module):
    """A sheet in a scene, stepped explicitly on a grid.

    It is differentiable in fabric, state, control and scene; in forward mode when the background
    allows it.

    - `scene`: sheet, pinned vertices, table, air, gravity.
    - `dt`: step, [s].
    - `fabric`: the stiffest that the solver will be used for; None: the step is not checked.
    - `grid`: of the `background`, which takes the scene's table and gravity when it is made: of
      others make another solver. Or the background itself.
    - `membrane_damping`: damping time of the membrane, [s]; None: the fabric's.
    - `relaxation`: of the membrane's viscosity, [s].
    - `forward_mode`: as in `Background`.
    - `transverse`: compression and shear between layers.
    - `cells`: as in `ExplicitCloth.grid`.

    Raises `ValueError` when the step is too long for the fabric (the text gives the limit) or
    the mesh is too coarse for the grid.
    """

    scene: Scene
    dt: float = eqx.field(static=True)
    background: Background
    transverse: Transverse
    membrane_damping: Float[Array, ""] | None
    relaxation: Float[Array, ""]
    cells: Cells | None = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        dt: float,
        fabric: Fabric | None = None,
        grid: Grid | None = None,
        membrane_damping: Scalar | None = None,
        relaxation: Scalar = RELAXATION,
        *,
        forward_mode: bool = False,
        background: Background | None = None,
        transverse: Transverse | None = None,
        cells: Cells | Literal["of the mesh"] | None = "of the mesh",
    ) -> None:
        check_kinds("MPMCloth(scene, dt, fabric, grid)", scene=(scene, Scene))
        positive("s", dt=dt)
        self.scene, self.dt = scene, float(dt)
        if background is None:
            if grid is None:
                raise ValueError("expected a grid, or a background")
            background = Background(grid, scene.table, scene.gravity, forward_mode=forward_mode)
        self.background, grid = background, background.grid
        edge = longest_edge(scene.mesh)
        if edge > COARSEST * grid.spacing:
            raise ValueError(
                f"the mesh has an edge of {edge:.4g} m, the grid a spacing of {grid.spacing:.4g} "
                f"m: edges may be {COARSEST} spacings long, or layers slip through between vertices"
            )
        self.transverse = transverse or between_layers()
        damping = None if membrane_damping is None else jnp.asarray(membrane_damping, float)
        self.membrane_damping, self.relaxation = damping, jnp.asarray(relaxation, float)
        self.cells = cells_of(scene.mesh) if cells == "of the mesh" else cells
        if fabric is not None:
            self.check(fabric)

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` when the step is too long for a fabric, unless that is traced."""
        check_fabric(fabric)
        mesh, spacing = self.scene.mesh, self.background.grid.spacing
        with jax.ensure_compile_time_eval():
            longest = stable_step(mesh, spacing, fabric, self.membrane_damping, self.relaxation)
        check_step(self.dt, longest, "the fabric, the mesh and the grid")

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Not judged where a fabric is traced."""
        return jnp.ones((), bool)

    def init(
        self, x: Vertices, v: Vertices | None = None, acceleration: Vertices | None = None
    ) -> MPMState:
        """A state from positions [m] and velocities [m/s] (default: zero), with free layers.

        The `acceleration` is not used. Raises `ValueError` when a vertex is outside the grid,
        unless positions are traced.
        """
        x, v, _ = self.scene.starting(x, v, acceleration)
        self.background.grid.check(x)
        normals = jax.vmap(unit_normal)(x[self.scene.mesh.faces])
        none = jnp.zeros((*x.shape, 3), x.dtype)
        memory = no_memory(self.scene.mesh, self.cells, x.dtype)
        return MPMState(x, v, none, normals, memory, no_failure())

    def step(self, fabric: Fabric, state: MPMState, control: Control) -> MPMState:
        """The state `dt` later, with the pinned vertices at `control.pinned`."""
        return self.step_with_forces(fabric, state, control)[0]

    def step_with_forces(
        self, fabric: Fabric, state: MPMState, control: Control
    ) -> tuple[MPMState, Float[Array, "pinned 3"]]:
        """The state `dt` later, and the grippers' mean forces [N] on the pinned vertices.

        The pinned vertices get their grippers' velocity twice: before the transfer to the grid and
        after the transfer back. The forces are the momentum that this takes, over `dt`.
        """
        check_step_arguments(self.scene, fabric, state, control, MPMState)
        mesh, pinned, dt = self.scene.mesh, self.scene.pinned, self.dt
        mass = fabric.density * mesh.vertex_area
        d = self._transverse_directions(fabric, state)
        force, stress = self._transverse_forces(state.x, d)
        inputs = ForceInputs.make(self, fabric, state, control.wind, state.memory, dt)
        of_sheet, memory = sheet_force(mesh, self.cells, inputs)
        force += of_sheet
        momentum = mass[:, None] * (1 - dt * fabric.mass_damping) * state.v + dt * force
        carried = (control.pinned - state.x[pinned]) / dt
        momentum_pinned = mass[pinned][:, None] * carried
        impulse = momentum_pinned - momentum[pinned]
        momentum = momentum.at[pinned].set(momentum_pinned)
        factor = dt * affine_factor(self.background.grid)
        affine = mass[:, None, None] * state.C - factor * stress
        v, C = self.background.advance(dt, fabric.friction, state.x, mass, momentum, affine)
        impulse += momentum_pinned - mass[pinned][:, None] * v[pinned]
        v = v.at[pinned].set(carried)
        moved = state.x + dt * v
        failure = failure_of_step(self.background.grid, state.x, moved, (fabric, control))
        inside = self.background.grid.inside(control.pinned)[:, None]
        goal = jnp.where(inside, control.pinned, jnp.nan)
        x = self.background.project(moved).at[pinned].set(goal)
        failure = first_failure(state.failure, failure)
        return MPMState(x, v, C, d, memory, failure), impulse / dt

    def _transverse_directions(self, fabric: Fabric, state: MPMState) -> Float[Array, "face 3"]:
        """The directions that the grid's velocity gradient carries, after the return mapping."""
        faces = self.scene.mesh.faces
        rates = jnp.mean(state.C[faces], axis=1)
        moved = state.d + self.dt * jnp.sum(rates * state.d[:, None], axis=2)
        mapped = jax.vmap(self.transverse.return_mapping, in_axes=(0, 0, None))
        return mapped(state.x[faces], moved, fabric.friction)

    def _transverse_forces(
        self, x: Vertices, d: Float[Array, "face 3"]
    ) -> tuple[Vertices, Float[Array, "vertex 3 3"]]:
        """Forces [N] and stresses times volume [N m] of the vertices from layers in contact."""
        mesh = self.scene.mesh
        forces, stresses = jax.vmap(self.transverse.stress)(x[mesh.faces], d)
        shares = (mesh.area / 3)[:, None, None] * stresses
        stress = jnp.zeros((*x.shape, 3), x.dtype).at[mesh.faces].add(shares[:, None])
        force = jnp.zeros_like(x).at[mesh.faces].add(mesh.area[:, None, None] * forces)
        return force, stress


@eqx.filter_jit
def stable_step(
    mesh: Mesh,
    spacing: float,
    fabric: Fabric,
    membrane_damping: Float[Array, ""] | float | None = None,
    relaxation: Float[Array, ""] | float = RELAXATION,
) -> Float[Array, ""]:
    """The longest step [s] that is stable for a fabric near its rest shape.

    - `spacing`: of the grid, [m].
    - `membrane_damping`, `relaxation`: as in `MPMCloth`, [s].

    The squares of the highest frequencies of membrane, bending and layers have bounds that add.
    The grid only lowers the frequencies of the mesh.
    """
    layers = between_layers().frequency(fabric.density, spacing), jnp.zeros((), float)
    return stable_sheet_step(mesh, fabric, membrane_damping, relaxation, [layers])


def between_layers() -> Transverse:
    """Compression and shear between layers."""
    return Transverse(*(jnp.asarray(value, float) for value in (CONTACT, CONTACT, ONSET)))


def longest_edge(mesh: Mesh) -> float:
    """The length of the longest edge of a mesh at rest, [m]."""
    corners = np.asarray(mesh.rest)[np.asarray(mesh.faces)]
    return float(np.max(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))
