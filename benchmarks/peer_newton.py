"""Newton's cloths in the scene "hang", on the same mesh, recorded as graphs (also on the CPU).

Their membrane is a stable neo-Hookean one, with the same stiffness as r2s's at small strains; their
bending is scaled edge by edge to that of r2s. "Explicit" is `SolverSemiImplicit`, a semi-implicit
Euler, whose damping also acts on rigid rotations; that of VBD does not.
"""

from functools import partial

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import scenes
import warp as wp  # pyright: ignore[reportMissingImports]

from r2s.units import GRAVITY

wp.config.quiet = True
MU = scenes.MEMBRANE[3]  # [N/m]
LAMBDA = {"explicit": scenes.MEMBRANE[1] + MU, "VBD": scenes.MEMBRANE[1]}  # [N/m]
ITERATIONS = 10  # of VBD, Newton's default


def _model(kind: str, size: int, damping: float, differentiable: bool):
    mesh = scenes.sheet(size)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    # both damp (part of) the shear as r2s does; VBD's acts on the rate of F^T F, twice that of E
    share = 1.0 if kind == "explicit" else 0.5
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        scale=1.0,
        vertices=[wp.vec3(*x) for x in np.asarray(scenes.flat(mesh)).tolist()],
        indices=np.asarray(mesh.faces).ravel().tolist(),
        density=scenes.DENSITY,
        tri_ke=MU,
        tri_ka=LAMBDA[kind],
        tri_kd=share * damping * MU,
        tri_drag=0.0,
        tri_lift=0.0,
        edge_ke=1.0,
        edge_kd=0.0,
        particle_radius=1e-4,
    )
    for corner in (0, size - 1):
        builder.particle_mass[corner] = 0.0
        builder.particle_flags[corner] &= ~newton.ParticleFlags.ACTIVE
    if kind == "VBD":
        builder.color()
    model = builder.finalize(requires_grad=differentiable)
    model.particle_grid = None  # no contact between particles
    _set_bending(model, kind, scenes.SIDE / (size - 1))
    return model


def _set_bending(model, kind: str, cell: float) -> None:
    """Hinges with r2s's stiffness k l^2 / A, where A is a cell's area.

    Newton multiplies by the edge's length l, and `SolverSemiImplicit` by A too.
    """
    area = cell**2
    properties = model.edge_bending_properties.numpy()
    length = model.edge_rest_length.numpy()
    properties[:, 0] = scenes.BENDING * length / area
    if kind == "explicit":
        properties[:, 0] /= area
    model.edge_bending_properties.assign(properties)


def _solver(kind: str, model):
    if kind == "VBD":
        return newton.solvers.SolverVBD(model, iterations=ITERATIONS)
    return newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)


def _forward(kind: str, size: int, substeps: int, damping: float):
    if substeps % 2:
        raise ValueError(f"two states take turns: substeps must be even, got {substeps}")
    model = _model(kind, size, damping, False)
    solver, control = _solver(kind, model), model.control()
    state, other, start = model.state(), model.state(), model.state()

    def frame():
        a, b = state, other
        for _ in range(substeps):
            a.clear_forces()
            solver.step(a, b, control, None, 1 / (60 * substeps))
            a, b = b, a

    materials = model.tri_materials.numpy().copy()  # on the CPU it is a view

    def reset(stiffness):
        model.tri_materials.assign(materials * np.array([stiffness, stiffness, 1, 1, 1]))
        wp.copy(state.particle_q, start.particle_q)
        wp.copy(state.particle_qd, start.particle_qd)

    frame()  # loads the kernels
    with wp.ScopedCapture() as capture:
        frame()

    def call(stiffness=1.0):
        reset(stiffness)
        frames = []
        for _ in range(scenes.FRAMES):
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
    """As `ours.gradient`, with all materials and masses, of the explicit solver by `wp.Tape`."""
    model = _model("explicit", size, damping, True)
    solver, control = _solver("explicit", model), model.control()
    states = [model.state() for _ in range(scenes.FRAMES * substeps + 1)]
    loss = wp.zeros(1, dtype=float, requires_grad=True)
    start, weight = wp.clone(states[0].particle_q), 1 / (scenes.FRAMES * size**2)

    def forward():
        for before, after in zip(states, states[1:], strict=False):
            before.clear_forces()
            solver.step(before, after, control, None, 1 / (60 * substeps))
        for state in states[substeps::substeps]:
            wp.launch(_add_squares, size**2, [state.particle_q, start, weight, loss])

    tape = wp.Tape()
    with wp.ScopedCapture() as capture:
        loss.zero_()
        with tape:
            forward()
        tape.backward(loss)

    def call():
        tape.zero()  # a graph on the CPU leaves it out
        wp.capture_launch(capture.graph)
        slope = model.tri_materials.grad.numpy().astype(float).sum(axis=0)
        return float(loss.numpy()[0]), slope[0] * MU + slope[1] * LAMBDA["explicit"]

    return call


forward_explicit = partial(_forward, "explicit")
forward_vbd = partial(_forward, "VBD")
