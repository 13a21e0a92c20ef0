"""A motion with its forces and its energy balance."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.environment.air import drag_on_vertices
from r2s.environment.scene import Control, along_path
from r2s.materials.fabric import Fabric
from r2s.materials.wrinkling import membrane_on_samples
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import on_samples
from r2s.mesh.surface import vertex_masses
from r2s.scenarios.scenario import Scenario, SheetSolver, as_cut, begin, stepped
from r2s.solvers.simulate import grouped

Energies = Float[Array, " frame"]


class EnergyBalance(eqx.Module):
    """A motion with its forces [N], and its energies, [J], at every simulated frame
    (`r2s.scenarios.scenario.at_frames` leads to a recording's).

    - `x`, `v`: positions [m] and velocities [m/s].
    - `forces`: of the grippers on each pinned vertex, mean since the frame before. `last`: the same
      at the frame itself, at the end of the last step.
    - `stored`: in membrane and bending; `kinetic`; `potential`: of gravity, above z = 0.
    - `grippers`, `air`: their work on the sheet since the first frame.
    - `dissipated`: that work less what the sheet holds more: damping, friction, and the error of
      the time steps. Energy of contacts counts as dissipated until it comes back.
    """

    x: Float[Array, "frame vertex 3"]
    v: Float[Array, "frame vertex 3"]
    forces: Float[Array, "frame gripper 3"]
    last: Float[Array, "frame gripper 3"]
    stored: Energies
    kinetic: Energies
    potential: Energies
    grippers: Energies
    air: Energies

    @property
    def dissipated(self) -> Energies:
        held = self.stored + self.kinetic + self.potential
        return self.grippers + self.air - (held - held[0])


def energy_balance(
    scenario: Scenario,
    fabric: Fabric,
    max_step: float | None = None,
    solver: SheetSolver | None = None,
) -> EnergyBalance:
    """The motion of a fabric with forces and energies, from the first frame on.

    The arguments are those of `rollout`. The grippers' work is the mean of their forces at both
    ends of a step times the displacement; the air's is that in the middle of the step.
    """
    solver, substeps = stepped(scenario, max_step, solver)
    fabric = as_cut(scenario, fabric)
    scene = scenario.scene
    mesh, pinned = scene.mesh, scene.pinned

    def step(carried: Any, control: Control):
        state, before = carried
        after, forces = solver.step_with_forces(fabric, state, control)
        moved = after.x - state.x
        middle = (state.x + after.x) / 2, (state.v + after.v) / 2
        drag = drag_on_vertices(mesh, scene.air, scene.fan, *middle, control.wind)
        work = jnp.sum((before + forces) / 2 * moved[pinned]), jnp.sum(drag * moved)
        return (after, forces), (forces, *work)

    def frame(carried: Any, control: Control):
        (state, last), (forces, *work) = jax.lax.scan(step, carried, control)
        mean = jnp.mean(forces, axis=0)
        return (state, last), (state.x, state.v, mean, last, *(jnp.sum(part) for part in work))

    start = begin(solver, scenario), jnp.zeros((len(pinned), 3), float)
    control = grouped(scenario.controls(substeps), substeps)
    _, (x, v, forces, last, grippers, air) = jax.lax.scan(frame, start, control)
    first = scenario.lead_in - 1

    def since(work):
        return jnp.cumsum(work[first:]) - work[first]

    x, v = x[first:], v[first:]
    mass = vertex_masses(mesh, fabric.density)
    return EnergyBalance(
        x=x,
        v=v,
        forces=forces[first:],
        last=last[first:],
        stored=jax.vmap(lambda x: stored_energy(mesh, fabric, x))(x),
        kinetic=jnp.sum(mass[None] * jnp.sum(v**2, axis=2), axis=1) / 2,
        potential=scene.gravity * jnp.sum(mass[None] * x[..., 2], axis=1),
        grippers=since(grippers),
        air=since(air),
    )


def clamp_force(scenario: Scenario, found: EnergyBalance) -> Float[Array, "frame 3"]:
    """The force [N] on the pulled clamp of a stretching at its frames, as a load cell shows it.

    Not the mean since the frame before, which lags by half a frame. The clamp is the pinned
    vertices at the end of the warp.
    """
    mesh, pinned = scenario.scene.mesh, scenario.scene.pinned
    pulled = mesh.rest[pinned, 0] > jnp.max(mesh.rest[:, 0]) / 2
    force = jnp.sum(jnp.where(pulled[None, :, None], found.last, 0), axis=1)
    if scenario.frame_times is None:
        return force
    return along_path(scenario.places, jnp.arange(len(force)).astype(float), force[:, None])[:, 0]


def stored_energy(mesh: Mesh, fabric: Fabric, x: Float[Array, "vertex 3"]) -> Float[Array, ""]:
    """The energy [J] in the strains and curvatures of a sheet at positions [m].

    Of laws by table: that of the stiffness it has there.
    """
    strain = mesh.samples.strains(x)
    stretched = membrane_on_samples(mesh.samples, fabric.membrane, fabric.bending, strain)
    membrane = on_samples(lambda law, strain: law.energy_density(strain), stretched, strain)
    bends = fabric.bending.bends(mesh)
    bent = bends.curvatures_at(x)
    laws = fabric.bending.on_elements(mesh, bent)
    curvatures = fabric.bending.curvatures(mesh, bent)
    bending = jax.vmap(lambda law, curvature: law.energy_density(curvature))(laws, curvatures)
    return jnp.sum(mesh.samples.areas * membrane) + jnp.sum(fabric.bending.areas(mesh) * bending)
