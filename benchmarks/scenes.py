"""The scenes of the benchmarks, and the cloth of r2s in them.

"hang": a sheet of 1 m x 1 m and 0.2 kg/m^2, flat and horizontal at the start, held at two
neighbouring corners, falls and swings for a second in vacuum. An isotropic membrane with
E h = 2667 N/m and Poisson's ratio 1/3, so C = (3000, 1000, 3000, 1000) N/m; 0.2 mm thick, which
makes its bending stiffness 1e-5 N m.

"lift": a sheet of 1 m x 1 m of camel ponte roma, flat in still air, is carried by one corner along
(0.25, 0.25, 0.5) m in 2.4 s and 60 steps, as in DiffSim's public examples.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

import r2s
from r2s.fabrics import presets
from r2s.units import GRAVITY, isotropic_bending, isotropic_membrane
from r2s.world.air import Air
from r2s.world.contact import Table

SIDE = 1.0  # of the sheet, [m]
DENSITY = 0.2  # [kg/m^2]
THICKNESS = 2e-4  # [m]; only where a peer asks for it
POISSONS_RATIO = 1 / 3
YOUNGS_MODULUS = 8000 / 3 / THICKNESS  # [Pa]
MEMBRANE = tuple(
    float(c) for c in isotropic_membrane(YOUNGS_MODULUS, POISSONS_RATIO, THICKNESS)
)  # C11, C12, C22, C33, [N/m]
BENDING = float(isotropic_bending(YOUNGS_MODULUS, POISSONS_RATIO, THICKNESS))  # [N m]
FRAMES = 60  # of 1/60 s
EXPLICIT_STEPS = 2  # in a frame, each of as many substeps as are needed
LIFT_FRAMES, LIFT_STEP = 60, 0.04  # [s]
LIFT_SHIFT = (0.25, 0.25, 0.5)  # [m]

Motion = Float[Array, "frame vertex 3"]


def sheet(size: int, elements: str = "wrinkling") -> r2s.Mesh:
    """The square with `size` vertices a side; 0 and `size` - 1 are neighbouring corners."""
    return r2s.rectangle((SIDE, SIDE), (size, size), elements)


def flat(mesh: r2s.Mesh) -> Float[Array, "vertex 3"]:
    """Its positions at the start [m], horizontal."""
    return jnp.pad(mesh.rest, ((0, 0), (0, 1)))


def fabric(damping: float, stiffness: float = 1.0) -> r2s.Fabric:
    """The fabric of "hang", with a damping time [s] and `stiffness` times its membrane."""
    c11, c12, c22, c33 = (stiffness * c for c in MEMBRANE)
    return r2s.Fabric.make(DENSITY, (c11, c12, c22, c33), BENDING, damping=damping)


def hang(
    size: int,
    substeps: int,
    frames: int = FRAMES,
    elements: str = "wrinkling",
    spectral_radius: float | None = None,
):
    """Solver, start and controls of "hang" with `substeps` steps in a frame of 1/60 s.

    `elements`: of the mesh. `spectral_radius`: see `r2s.Cloth.make`.
    """
    mesh = sheet(size, elements)
    held = jnp.array([0, size - 1])
    scene = r2s.Scene(mesh, held, Table.make(-jnp.inf), Air.make(density=0.0))
    solver = r2s.Cloth.make(scene, 1 / (60 * substeps), spectral_radius=spectral_radius)
    x = flat(mesh)
    falling = jnp.where(scene.is_free[:, None], jnp.array([[0.0, 0.0, -GRAVITY]]), 0)
    handles = jnp.broadcast_to(x[held], (frames, substeps, 2, 3))
    controls = r2s.Control(handles, jnp.zeros((frames, substeps, 3)))
    return solver, solver.init(x, acceleration=falling), controls


def explicit_hang(size: int, fabric: r2s.Fabric, frames: int = FRAMES, finer: int = 1):
    """As `hang`, in explicit steps of a frame, for a fabric or a batch of them; `finer`: times as
    many substeps as are needed."""
    solver, start, controls = hang(size, EXPLICIT_STEPS, frames)
    explicit = r2s.ExplicitCloth.make(solver.scene, solver.dt, fabric)
    explicit = dataclasses.replace(explicit, substeps=finer * explicit.substeps)
    return explicit, explicit.init(start.x), controls


def lift(size: int):
    """Fabric, solver, start and controls of "lift"."""
    mesh = sheet(size)
    scene = r2s.Scene(mesh, jnp.array([0]), Table.make(-jnp.inf), Air.make(1.0, 2.0, 0.0))
    solver = r2s.Cloth.make(scene, LIFT_STEP)
    x = flat(mesh)
    time = jnp.arange(1, LIFT_FRAMES + 1)[:, None, None, None] / LIFT_FRAMES
    handles = x[:1] + time**2 * (3 - 2 * time) * jnp.array(LIFT_SHIFT)  # a smoothstep
    controls = r2s.Control(handles, jnp.zeros((LIFT_FRAMES, 1, 3)))
    return presets.camel_ponte_roma(), solver, solver.init(x), controls


def loss(x: Motion, start: Float[Array, "vertex 3"]) -> Float[Array, ""]:
    """The mean squared distance from the start [m^2], over frames and vertices."""
    return jnp.mean(jnp.sum((x - start) ** 2, axis=-1))


def motion(fabric: r2s.Fabric, solver, start, controls: r2s.Control):
    """The positions [m] at the end of every frame."""
    return r2s.simulate(solver, fabric, start, controls).x


def motion_loss(fabric: r2s.Fabric, solver, start, controls) -> Float[Array, ""]:
    """`loss` of `motion`."""
    return loss(motion(fabric, solver, start, controls), start.x)
