"""A sheet of fabric by the material point method: a mesh whose vertices are the particles.

After Jiang, Gast and Teran 2017, whom DiffCP (Zheng et al. 2024) follows. The laws of membrane and
bending, the mesh and the `Fabric` are those of `r2s.Cloth`. The forces on the vertices go through
the grid; across the sheet the grid's velocity gradient drives compression and shear between layers
(`transverse`). So contact of the sheet with itself, with the table and with walls comes
from the grid, and keeps layers about a spacing apart. The steps are explicit in time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.solvers.explicit.elements import bending_frequency, membrane_frequency
from r2s.solvers.explicit.sheet import Cells, ForceInputs, Memory, cells_of, no_memory, sheet_force
from r2s.solvers.explicit.stability import RELAXATION, Viscosity, check_step, longest_relaxing_step
from r2s.solvers.failures import first_failure, no_failure
from r2s.solvers.mpm.background import Background
from r2s.solvers.mpm.grid import Grid, failure_of_step
from r2s.solvers.mpm.transfer import affine_factor

Vector = Float[Array, " 3"]

SMOOTHING = 1e-6  # [-]: added to the tilt's norm, which is then differentiable at no tilt


class Transverse(eqx.Module):
    """The stiffnesses of contact between layers.

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
        return (
            self.compression / 3 * jnp.maximum(self.onset - along, 0) ** 3 + self.shear / 2 * tilt
        )

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
        [N/m], which goes to the grid.

        Together they exert no torque, since rotations do not change the energy.
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


Vertices = Float[Array, "vertex 3"]

COARSEST = 1.8  # longest edge of a mesh over the grid's spacing, so that layers cannot pass
ONSET = 0.5  # [-]: layers press when they are about a spacing apart
CONTACT = 20.0  # [N/m]: some cm of a fabric's weight press layers together by a tenth


class SheetState(eqx.Module):
    """A sheet at one time.

    - `x`, `v`: positions [m] and velocities [m/s] of the vertices.
    - `C`: affine velocity matrices of the vertices, [1/s].
    - `d`: transverse directions of the faces, [-].
    - `memory`: of the membrane's samples.
    - `failure`: the first `r2s.solvers.failures.Failure` of the run so far.
    """

    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    C: Float[Array, "vertex 3 3"]
    d: Float[Array, "face 3"]
    memory: Memory
    failure: Int[Array, ""]


class Sheet(eqx.Module):
    """A sheet in a scene, stepped explicitly on a grid.

    It is differentiable in fabric, state, control and scene; in forward mode when the background
    allows it.

    - `scene`: sheet, held vertices, air; its table is the background's.
    - `background`: grid, table, walls, gravity.
    - `transverse`: compression and shear between layers.
    - `membrane_damping`: damping time of the membrane, [s]; None: the fabric's.
    - `relaxation`: of the membrane's viscosity, [s].
    - `dt`: step, [s].
    - `cells`: as in `ExplicitCloth.grid`.
    """

    scene: Scene
    background: Background
    transverse: Transverse
    membrane_damping: Float[Array, ""] | None
    relaxation: Float[Array, ""]
    dt: float = eqx.field(static=True)
    cells: Cells | None = eqx.field(static=True)

    @classmethod
    def make(
        cls,
        scene: Scene,
        grid: Grid,
        fabric: Fabric,
        dt: float,
        membrane_damping: float | None = None,
        relaxation: float = RELAXATION,
        forward_mode: bool = False,
    ) -> "Sheet":
        """A solver for a scene on a grid, in steps `dt` [s].

        - `fabric`: the stiffest that the solver will be used for.
        - `membrane_damping`, `relaxation`: as in `ExplicitCloth.make`, [s].
        - `forward_mode`: as in `Background`.

        Raises `ValueError` when the step is too long for the fabric (the text gives the limit) or
        the mesh is too coarse for the grid.
        """
        if not dt > 0:
            raise ValueError(f"dt must be positive, got {dt} s")
        edge = longest_edge(scene.mesh)
        if edge > COARSEST * grid.spacing:
            raise ValueError(
                f"the mesh has an edge of {edge:.4g} m, the grid a spacing of {grid.spacing:.4g} "
                f"m: edges may be {COARSEST} spacings long, or layers slip through between vertices"
            )
        solver = cls(
            scene,
            Background.make(grid, scene.table, forward_mode=forward_mode),
            between_layers(),
            None if membrane_damping is None else jnp.asarray(membrane_damping, float),
            jnp.asarray(relaxation, float),
            float(dt),
            cells_of(scene.mesh),
        )
        solver.check(fabric)
        return solver

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` when the step is too long for a fabric, unless that is traced."""
        mesh, spacing = self.scene.mesh, self.background.grid.spacing
        with jax.ensure_compile_time_eval():
            times = self.membrane_damping, self.relaxation
            longest = stable_step(mesh, spacing, fabric, *times)
        check_step(self.dt, longest, "the fabric, the mesh and the grid")

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Not judged where a fabric is traced."""
        return jnp.ones((), bool)

    def init(
        self, x: Vertices, v: Vertices | None = None, acceleration: Vertices | None = None
    ) -> SheetState:
        """A state from positions [m] and velocities [m/s] (default: zero), with free layers.

        The `acceleration` is not used. Raises `ValueError` when a vertex is outside the grid,
        unless positions are traced.
        """
        self.background.grid.check(x)
        v = jnp.zeros_like(x) if v is None else v
        normals = jax.vmap(unit_normal)(x[self.scene.mesh.faces])
        none = jnp.zeros((*x.shape, 3), x.dtype)
        memory = no_memory(self.scene.mesh, self.cells, x.dtype)
        return SheetState(x, v, none, normals, memory, no_failure())

    def step(self, fabric: Fabric, state: SheetState, control: Control) -> SheetState:
        """The state `dt` later, with the held vertices at `control.handles`."""
        return self.step_with_forces(fabric, state, control)[0]

    def step_with_forces(
        self, fabric: Fabric, state: SheetState, control: Control
    ) -> tuple[SheetState, Float[Array, "handle 3"]]:
        """The state `dt` later, and the grippers' mean forces [N] on the held vertices.

        The held vertices get their grippers' velocity twice: before the transfer to the grid and
        after the transfer back. The forces are the momentum that this takes, over `dt`.
        """
        mesh, held, dt = self.scene.mesh, self.scene.held, self.dt
        mass = fabric.density * mesh.vertex_area
        d = self._transverse_directions(fabric, state)
        force, stress = self._transverse_forces(state.x, d)
        of_sheet, memory = self._sheet_forces(fabric, state, control)
        force += of_sheet
        momentum = mass[:, None] * (1 - dt * fabric.mass_damping) * state.v + dt * force
        carried = (control.handles - state.x[held]) / dt
        momentum_held = mass[held][:, None] * carried
        impulse = momentum_held - momentum[held]
        momentum = momentum.at[held].set(momentum_held)
        factor = dt * affine_factor(self.background.grid)
        affine = mass[:, None, None] * state.C - factor * stress
        v, C = self.background.advance(dt, fabric.friction, state.x, mass, momentum, affine)
        impulse += momentum_held - mass[held][:, None] * v[held]
        v = v.at[held].set(carried)
        moved = state.x + dt * v
        failure = failure_of_step(self.background.grid, state.x, moved, (fabric, control))
        inside = self.background.grid.inside(control.handles)[:, None]
        handles = jnp.where(inside, control.handles, jnp.nan)
        x = self.background.project(moved).at[held].set(handles)
        failure = first_failure(state.failure, failure)
        return SheetState(x, v, C, d, memory, failure), impulse / dt

    def _transverse_directions(self, fabric: Fabric, state: SheetState) -> Float[Array, "face 3"]:
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

    def _sheet_forces(
        self, fabric: Fabric, state: SheetState, control: Control
    ) -> tuple[Vertices, Memory]:
        """Forces [N] of membrane, bending and air on the vertices, and the samples' memory."""
        scene, x, v = self.scene, state.x, state.v
        damping = fabric.damping if self.membrane_damping is None else self.membrane_damping
        viscosity = Viscosity.make(damping, self.relaxation, jnp.asarray(self.dt, x.dtype))
        around = viscosity, scene.air, scene.fan
        inputs = ForceInputs(fabric, *around, x, v, control.wind, state.memory)
        return sheet_force(scene.mesh, self.cells, inputs)


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
    - `membrane_damping`, `relaxation`: as in `Sheet`, [s].

    The squares of the highest frequencies of membrane, bending and layers have bounds that add.
    The grid only lowers the frequencies of the mesh.
    """
    damping = fabric.damping if membrane_damping is None else jnp.asarray(membrane_damping, float)
    layers = between_layers().frequency(fabric.density, spacing)
    others = [(bending_frequency(mesh, fabric), fabric.damping), (layers, jnp.zeros((), float))]
    membrane, relaxing = membrane_frequency(mesh, fabric), jnp.asarray(relaxation, float)
    return longest_relaxing_step(membrane, damping, relaxing, others)


def between_layers() -> Transverse:
    """Compression and shear between layers."""
    return Transverse(*(jnp.asarray(value, float) for value in (CONTACT, CONTACT, ONSET)))


def longest_edge(mesh: Mesh) -> float:
    """The length of the longest edge of a mesh at rest, [m]."""
    corners = np.asarray(mesh.rest)[np.asarray(mesh.faces)]
    return float(np.max(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))
