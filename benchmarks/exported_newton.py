"""The scenes of `exported` in Newton's semi-implicit solver, by `r2s.export.newton`."""

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]

from r2s.export import newton as export
from r2s.units import GRAVITY

wp.config.quiet = True
STEP = 2e-5  # [s]


@wp.kernel
def _after(
    x: wp.array(dtype=wp.vec3),  # pyright: ignore[reportInvalidTypeForm]
    v: wp.array(dtype=wp.vec3),  # pyright: ignore[reportInvalidTypeForm]
    held: wp.array(dtype=int),  # pyright: ignore[reportInvalidTypeForm]
    path: wp.array2d(dtype=wp.vec3),  # pyright: ignore[reportInvalidTypeForm]
    step: wp.array(dtype=int),  # pyright: ignore[reportInvalidTypeForm]
    kept: float,
):
    """Brake the velocities, put the held vertices where they belong, and count the step."""
    i = wp.tid()
    v[i] = v[i] * kept
    if i < held.shape[0]:
        x[held[i]] = path[step[0], i]


@wp.kernel
def _count(step: wp.array(dtype=int)):  # pyright: ignore[reportInvalidTypeForm]
    step[0] = step[0] + 1


def _model(fabric, mesh, held, start: np.ndarray, yarns: bool):
    cloth, loss = export.cloth(fabric, mesh, "semi_implicit", yarns=yarns)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        scale=1.0,
        vertices=[wp.vec3(*x) for x in start.tolist()],
        indices=np.asarray(mesh.faces).ravel().tolist(),
        **cloth.arguments,
    )
    if cloth.springs is not None:
        for spring in export.spring_arguments(cloth.springs, float(fabric.damping)):
            builder.add_spring(**spring)
    for vertex in held:
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~newton.ParticleFlags.ACTIVE
    model = builder.finalize()
    model.particle_grid = None  # no contact between particles
    export.set_edges(model, fabric, mesh, "semi_implicit")
    return model, loss


def motion(fabric, mesh, held, path, frames: int, rate: float, yarns: bool):
    """As `exported_mujoco.motion`."""
    start = np.pad(np.asarray(mesh.rest, float), ((0, 0), (0, 1)))
    start[:, 2] = path(0.0)[0, 2]
    model, loss = _model(fabric, mesh, held, start, yarns)
    solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    control, state, other = model.control(), model.state(), model.state()
    steps = 2 * round(0.5 / rate / STEP)  # two states take turns
    dt = 1 / rate / steps
    times = np.arange(1, frames * steps + 1) * dt
    places = wp.array(np.stack([path(t) for t in times]).astype(np.float32), dtype=wp.vec3)
    index, counter = wp.array(list(held), dtype=int), wp.zeros(1, dtype=int)
    kept = float(np.exp(-float(fabric.mass_damping) * dt))

    def frame():
        before, after = state, other
        for _ in range(steps):
            before.clear_forces()
            solver.step(before, after, control, None, dt)
            args = [after.particle_q, after.particle_qd, index, places, counter, kept]
            wp.launch(_after, len(start), args)
            wp.launch(_count, 1, [counter])
            before, after = after, before

    frame()  # loads the kernels
    with wp.ScopedCapture() as capture:
        frame()
    fresh = model.state()
    for one, to in ((fresh.particle_q, state.particle_q), (fresh.particle_qd, state.particle_qd)):
        wp.copy(to, one)
    counter.zero_()
    found = []
    for _ in range(frames):
        wp.capture_launch(capture.graph)
        found.append(state.particle_q.numpy().copy())
    return np.stack(found), loss
