"""The scene "hang", and the cloth of r2s in it.

A sheet of 1 m x 1 m and 0.2 kg/m^2, flat and horizontal at the start, held at two neighbouring
corners, falls and swings for a second in vacuum. Its membrane is isotropic, with E h = 2667 N/m and
Poisson's ratio 1/3; its bending stiffness is that of a plate of 0.2 mm.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import r2s
from r2s._util.units import GRAVITY

SIDE = 1.0  # of the sheet, [m]
DENSITY = 0.2  # [kg/m^2]
MEMBRANE = 3000.0, 1000.0, 3000.0, 1000.0  # C11, C12, C22, C33, [N/m]
BENDING = 1e-5  # [N m]
FRAMES = 60  # of 1/60 s
EXPLICIT_STEPS = 2  # in a frame, each of as many substeps as are needed


def sheet(size: int, elements: str = "wrinkling") -> r2s.Mesh:
    """The square with `size` vertices a side; 0 and `size` - 1 are neighbouring corners."""
    return r2s.rectangle((SIDE, SIDE), (size, size), elements)


def flat(mesh: r2s.Mesh) -> Float[Array, "vertex 3"]:
    """Its positions at the start [m], horizontal."""
    return jnp.pad(mesh.rest, ((0, 0), (0, 1)))


def fabric(damping: float) -> r2s.Fabric:
    """The fabric, with a damping time [s]."""
    return r2s.Fabric.make(DENSITY, MEMBRANE, BENDING, damping=damping)


def hang(
    size: int,
    substeps: int,
    frames: int = FRAMES,
    elements: str = "wrinkling",
    spectral_radius: float | None = None,
):
    """Solver, start, control and the `substeps` implicit steps in a frame of 1/60 s.

    `elements`: of the mesh. `spectral_radius`: see `r2s.ImplicitCloth`.
    """
    mesh = sheet(size, elements)
    pinned = jnp.array([0, size - 1])
    scene = r2s.Scene(mesh, pinned, air=None)
    solver = r2s.ImplicitCloth(scene, 1 / (60 * substeps), spectral_radius=spectral_radius)
    x = flat(mesh)
    falling = jnp.where(scene.is_free[:, None], jnp.array([[0.0, 0.0, -GRAVITY]]), 0)
    control = r2s.Control(jnp.broadcast_to(x[pinned], (frames * substeps, 2, 3)))
    return solver, solver.init(x, acceleration=falling), control, substeps


def explicit_hang(size: int, fabric: r2s.Fabric, frames: int = FRAMES, finer: int = 1):
    """As `hang`, in explicit steps of a frame, for a fabric or a batch of them.

    `finer`: times as many substeps as are needed.
    """
    solver, start, control, every = hang(size, EXPLICIT_STEPS, frames)
    explicit = r2s.ExplicitCloth(solver.scene, float(solver.dt), fabric)
    explicit = dataclasses.replace(explicit, substeps=finer * explicit.substeps)
    return explicit, explicit.init(start.x), control, every


def motion(fabric: r2s.Fabric, solver, start, control, every: int) -> Float[Array, "frame n 3"]:
    """The positions [m] at the end of every frame."""
    return r2s.simulate(solver, fabric, start, control, save_every=every).x


def motion_loss(fabric: r2s.Fabric, solver, start, control, every: int) -> Float[Array, ""]:
    """The mean squared distance from the start [m^2], over frames and vertices."""
    moved = motion(fabric, solver, start, control, every) - start.x
    return jnp.mean(jnp.sum(moved**2, axis=-1))


def forward(size: int, substeps: int, damping: float, **how):
    """A compiled function without arguments that gives the motion; `how`: see `hang`."""
    arguments = fabric(damping), *hang(size, substeps, **how)
    run = eqx.filter_jit(motion).lower(*arguments).compile()
    return lambda: np.asarray(run(*arguments))


def forward_explicit(size: int, finer: int, damping: float):
    """As `forward`, in explicit steps: `finer` times as many as are needed."""
    arguments = fabric(damping), *explicit_hang(size, fabric(damping), finer=finer)
    run = eqx.filter_jit(motion).lower(*arguments).compile()
    return lambda: np.asarray(run(*arguments))


def gradient(size: int, substeps: int, damping: float, **how):
    """As `forward`, giving the loss [m^2] and its gradient in the whole fabric."""
    arguments = fabric(damping), *hang(size, substeps, **how)
    run = eqx.filter_jit(eqx.filter_value_and_grad(motion_loss)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(run(*arguments))


forward_alpha = partial(forward, spectral_radius=0.6)
gradient_alpha = partial(gradient, spectral_radius=0.6)
forward_triangles = partial(forward, elements="rising")
gradient_triangles = partial(gradient, elements="rising")
