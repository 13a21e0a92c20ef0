"""Newton's semi-implicit Euler solver in the scene "hang", recorded as graphs (also on the CPU).

The sheet is that of `r2s.export.newton`: a neo-Hookean membrane with the same stiffness as r2s's at
small strains, and hinges. Its damping also acts on rigid rotations.
"""

import _hang
import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]

from r2s._util.units import GRAVITY
from r2s.export import newton as export

wp.config.quiet = True
KIND = "semi_implicit"


def _model(size: int, damping: float, differentiable: bool):
    """The model and its solver; `damping` [s], of the membrane."""
    mesh, fabric = _hang.sheet(size), _hang.fabric(0.0)
    arguments = export.cloth(fabric, mesh, KIND, yarns=False)[0].arguments
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        scale=1.0,
        vertices=[wp.vec3(*x) for x in np.asarray(_hang.flat(mesh)).tolist()],
        indices=np.asarray(mesh.faces).ravel().tolist(),
        **(arguments | {"tri_kd": damping * arguments["tri_ke"]}),
    )
    for corner in (0, size - 1):
        builder.particle_mass[corner] = 0.0
        builder.particle_flags[corner] &= ~newton.ParticleFlags.ACTIVE
    model = builder.finalize(requires_grad=differentiable)
    model.particle_grid = None  # no contact between particles
    return model, newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)


def forward(size: int, substeps: int, damping: float):
    """As `_hang.forward`; `substeps` is even, since two states take turns."""
    model, solver = _model(size, damping, False)
    control = model.control()
    state, other, start = model.state(), model.state(), model.state()

    def frame():
        a, b = state, other
        for _ in range(substeps):
            a.clear_forces()
            solver.step(a, b, control, None, 1 / (60 * substeps))
            a, b = b, a

    frame()  # loads the kernels
    with wp.ScopedCapture() as capture:
        frame()

    def call():
        wp.copy(state.particle_q, start.particle_q)
        wp.copy(state.particle_qd, start.particle_qd)
        frames = []
        for _ in range(_hang.FRAMES):
            wp.capture_launch(capture.graph)
            frames.append(state.particle_q.numpy().copy())
        return np.stack(frames)

    return call


@wp.kernel
def _add_squares(
    x: wp.array(dtype=wp.vec3),  # pyright: ignore[reportInvalidTypeForm]
    start: wp.array(dtype=wp.vec3),  # pyright: ignore[reportInvalidTypeForm]
    weight: float,
    loss: wp.array(dtype=float),  # pyright: ignore[reportInvalidTypeForm]
):
    moved = x[wp.tid()] - start[wp.tid()]
    wp.atomic_add(loss, 0, weight * wp.dot(moved, moved))


def gradient(size: int, substeps: int, damping: float):
    """As `_hang.gradient`, in all materials and masses, by `wp.Tape`."""
    model, solver = _model(size, damping, True)
    control = model.control()
    states = [model.state() for _ in range(_hang.FRAMES * substeps + 1)]
    loss = wp.zeros(1, dtype=float, requires_grad=True)
    start, weight = wp.clone(states[0].particle_q), 1 / (_hang.FRAMES * size**2)

    def run():
        for before, after in zip(states, states[1:], strict=False):
            before.clear_forces()
            solver.step(before, after, control, None, 1 / (60 * substeps))
        for state in states[substeps::substeps]:
            wp.launch(_add_squares, size**2, [state.particle_q, start, weight, loss])

    tape = wp.Tape()
    with wp.ScopedCapture() as capture:
        loss.zero_()
        with tape:
            run()
        tape.backward(loss)

    def call():
        tape.zero()  # a graph on the CPU leaves it out
        wp.capture_launch(capture.graph)
        return float(loss.numpy()[0]), model.tri_materials.grad.numpy().sum(axis=0)

    return call
