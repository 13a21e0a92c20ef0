"""DiffSim's time step, on the laws and meshes of r2s, and the recorded trajectories of DiffSim.

One linearised backward-Euler solve a step (Qiao et al. 2020, after Narain et al. 2012). The normals
in the wind and the curvatures at which bending is looked up are those of the step before; handles
are springs; the geometric stiffness is that of tension only.
"""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from folders import SHARED
from jaxtyping import Array, Float, Int

from r2s.materials.bending import HingeBending, HingeLaw
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.tables import HINGE_FACTOR, LARGE_STRETCH, _between
from r2s.mesh.bends import hinge_angle
from r2s.mesh.mesh import Mesh
from r2s.mesh.strain_samples import green_strain

FOLDER = SHARED / "data" / "diffsim_reference"
FRAMES = 61  # as many as the longest of the recordings, so that all share one compilation
BAKED = 30  # samples along each axis of DiffSim's grid of membrane stiffness
BAKED_FROM = (-0.25, -0.25, 0.0)  # [-]: E11, E22 and |E12| of its first sample
Positions = Float[Array, "vertex 3"]


class DiffSimTableMembrane(eqx.Module):
    """A `TableMembrane` looked up as DiffSim does.

    It doubles the numbers, raises negative ones to zero, and shifts them by half a sample. The
    result is baked on a coarse grid of E11, E22 and |E12| (steps of 1/30), which is shifted by half
    a cell once more and interpolated linearly.
    """

    stiffness: Float[Array, "6 4"]

    def at(self, strain: Float[Array, " 3"]) -> OrthotropicMembrane:
        """The constant stiffness that DiffSim uses at a strain (E11, E22, 2 E12) [-]."""
        first = jnp.asarray(BAKED_FROM, strain.dtype)
        green = jnp.stack([strain[0], strain[1], jnp.abs(strain[2]) / 2])
        index = jnp.clip((green - first) * (BAKED**2 / (BAKED - 1)) - 0.5, 0, BAKED - 1)
        below = jnp.clip(jnp.floor(index), 0, BAKED - 2)
        above = index - below

        def weighed(corner: Float[Array, " 3"]) -> Float[Array, " 4"]:
            sample = self._sample(first + (below + corner) / BAKED)
            return jnp.prod(jnp.where(corner > 0, above, 1 - above)) * sample

        corners = jnp.indices((2, 2, 2)).reshape(3, 8).T.astype(strain.dtype)  # of the cell
        c11, c12, c22, c33 = jnp.sum(jax.vmap(weighed)(corners), axis=0)
        return OrthotropicMembrane(c11, c12, c22, c33 / 2)

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        return self.at(strain).energy_density(strain)

    def _sample(self, green: Float[Array, " 3"]) -> Float[Array, " 4"]:
        """One sample [N/m] of the baked grid, at (E11, E22, E12) [-]."""
        e11, e22, e12 = green
        difference, shear = e11 - e22, 2 * e12
        largest = 1 + e11 + e22 + jnp.sqrt(difference**2 + shear**2)
        weight = (jnp.sqrt(largest) - 1) / LARGE_STRETCH
        angle = 8 * (jnp.arctan2(shear, difference) / 2) / jnp.pi
        shifted = jnp.clip(2 * weight - 0.5, 0, 1)
        small, large = self.stiffness[0], _between(self.stiffness[1:], 1.25 * angle - 0.5)
        return jnp.maximum(2 * (small + shifted * (large - small)), 0)


class DiffSimTableBending(HingeLaw):
    """A `TableBending` looked up as DiffSim does: shifted by half an entry in both directions, with
    hinges that bend to one side as stiff as flat ones.
    """

    stiffness: Float[Array, "3 5"]

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> HingeBending:
        """The constant stiffness that DiffSim uses at a curvature [1/m], as of a `TableBending`."""
        row = 1.5 * (2 - 4 * direction / jnp.pi) - 0.5
        column = 1.25 * (-curvature / 10.0) - 0.5
        return HingeBending(_between(_between(self.stiffness, row), column) / HINGE_FACTOR)


class Setting(eqx.Module):
    """What DiffSim was told.

    - `start`: the positions at first, at rest, [m].
    - `mass`, `spring`: of each vertex, [kg], and of its handle if it has one, [N/m].
    - `dt`, `damping`: step and damping time, [s].
    - `gravity`: [m/s^2]. `wind`: [m/s], `air_density`: [kg/m^3].
    - `drag`: along the faces, [kg/s/m^2].
    - `knots`, `moves`, `rates`: of the handles' motion: times [s], displacements [m] and velocities
      [m/s] of the vertices there. Cubic between them: a smoothstep between two at rest.
    """

    mesh: Mesh
    membrane: DiffSimTableMembrane
    bending: DiffSimTableBending
    density: Float[Array, ""]
    start: Positions
    mass: Float[Array, " vertex"]
    spring: Float[Array, " vertex"]
    dt: Float[Array, ""]
    damping: Float[Array, ""]
    gravity: Float[Array, " 3"]
    wind: Float[Array, " 3"]
    air_density: Float[Array, ""]
    drag: Float[Array, ""]
    knots: Float[Array, " knot"]
    moves: Float[Array, "knot vertex 3"]
    rates: Float[Array, "knot vertex 3"]

    def moved(self, time: Float[Array, ""]) -> Positions:
        """How far the handles of the vertices have moved at a time [s], [m]."""
        i = jnp.clip(jnp.searchsorted(self.knots, time, side="right") - 1, 0, len(self.knots) - 2)
        span = self.knots[i + 1] - self.knots[i]
        s = jnp.clip((time - self.knots[i]) / span, 0, 1)
        values = (1 + 2 * s) * (1 - s) ** 2 * self.moves[i] + s**2 * (3 - 2 * s) * self.moves[i + 1]
        slopes = s * (1 - s) ** 2 * self.rates[i] - s**2 * (1 - s) * self.rates[i + 1]
        return values + span * slopes

    def target(self, time: Float[Array, ""]) -> Positions:
        """Where the handles are at a time [s], [m]: DiffSim measures from where they are after the
        first step, so that they lag by what they move in it."""
        return self.start + self.moved(time) - self.moved(self.dt)


class Trajectory(eqx.Module):
    """- `x`, `v`: positions [m] and velocities [m/s] of the frames.
    - `counts`: steps from the start to each frame.
    """

    x: Float[np.ndarray, "frame vertex 3"]
    v: Float[np.ndarray, "frame vertex 3"]
    counts: Int[np.ndarray, " frame"]


def load(path: Path) -> tuple[Setting, Trajectory]:
    """A recording of DiffSim. Raises `ValueError` when its handles moved otherwise than it says."""
    told, arrays = json.loads(path.with_suffix(".json").read_text()), np.load(path)
    mesh = Mesh.make(arrays["rest_uv"], arrays["faces"].astype(int))
    handles, array = arrays["handle_vertices"], lambda value: jnp.asarray(value, float)
    knots, moves, rates = _motion(told.get("handle_motion"), handles, mesh.rest.shape[0])
    setting = Setting(
        mesh=mesh,
        membrane=DiffSimTableMembrane(array(told["material_json"]["stretching"])),
        bending=DiffSimTableBending(array(told["material_json"]["bending"])),
        density=array(told["material_json"]["density"]),
        start=array(arrays["initial_position"]),
        mass=array(arrays["node_mass"]),
        spring=jnp.zeros(mesh.rest.shape[0]).at[handles].set(told["handle_stiffness"]),
        dt=array(told["dt"]),
        damping=array(told["damping"]),
        gravity=array(told["gravity"]),
        wind=array(told["wind"]["velocity"]),
        air_density=array(told["wind"]["density"]),
        drag=array(told["wind"]["drag"]),
        knots=array(knots),
        moves=array(moves),
        rates=array(rates),
    )
    counts = np.round(arrays["time"] / told["dt"]).astype(int)
    later = counts > 0  # before its first step DiffSim has the handles where they start
    found = np.asarray(jax.vmap(setting.target)(array(arrays["time"])))[:, handles]
    if np.any(np.abs(found - arrays["handle_target"])[later] > 1e-9):
        raise ValueError(f"{path}: the handles do not move as `handle_motion` says")
    return setting, Trajectory(arrays["position"], arrays["velocity"], counts)


def _motion(motions, handles, count):
    """Knots, displacements and velocities: one motion for all handles, or one for each.

    Between its ends a motion passes a knot with the mean velocity between its neighbours.
    """
    if not motions:
        return np.array([0.0, 1.0]), np.zeros((2, count, 3)), np.zeros((2, count, 3))
    knots = np.array([knot["time"] for knot in motions[0]], float)
    moves = np.zeros((len(knots), count, 3))
    still = {"translate": [0.0, 0.0, 0.0]}
    for motion, held in zip(motions, [handles] if len(motions) == 1 else handles, strict=True):
        transforms = [knot.get("transform", still) for knot in motion]
        if [knot["time"] for knot in motion] != list(knots) or any(
            set(transform) != set(still) for transform in transforms
        ):
            raise ValueError(f"expected translations at common times, got {motions}")
        way = np.array([transform["translate"] for transform in transforms], float)
        moves[:, held] = way[:, None] if np.ndim(held) else way
    rates = np.zeros_like(moves)
    rates[1:-1] = (moves[2:] - moves[:-2]) / (knots[2:] - knots[:-2])[:, None, None]
    return knots, moves, rates


@eqx.filter_jit
def run(setting: Setting, counts: Int[Array, " frame"]) -> tuple[Array, Array]:
    """Positions [m] and velocities [m/s] after numbers of steps."""

    def to_frame(carry, until):
        def before(carry):
            return carry[0] < until

        carry = jax.lax.while_loop(before, lambda carry: _step(setting, *carry), carry)
        return carry, (carry[1], carry[2])

    start = jnp.zeros((), int), setting.start, jnp.zeros_like(setting.start), setting.start
    return jax.lax.scan(to_frame, start, counts)[1]


def repeat(setting: Setting, counts: Int[np.ndarray, " frame"]) -> tuple[np.ndarray, np.ndarray]:
    """`run`, for any number of frames up to `FRAMES` without another compilation."""
    padded = np.pad(counts, (0, max(FRAMES - len(counts), 0)), mode="edge")
    x, v = run(setting, jnp.asarray(padded))
    return np.asarray(x)[: len(counts)], np.asarray(v)[: len(counts)]


def _step(setting, count, x, v, x_before):
    dt, n = setting.dt, x.shape[0]
    internal, stiffness = _internal(setting, x, x_before)
    spring = jnp.repeat(setting.spring, 3)
    target = setting.target(dt * (count + 1).astype(float))
    pull = setting.spring[:, None] * (target - x)
    weight = jnp.outer(setting.mass, setting.gravity)
    force = (weight + pull + wind_force(setting, v, x_before)).ravel() + internal
    lead = dt + setting.damping
    matrix = jnp.diag(jnp.repeat(setting.mass, 3) + dt**2 * spring) + dt * lead * stiffness
    change = dt * (force - (lead * stiffness @ v.ravel() + dt * spring * v.ravel()))
    v = v + jnp.linalg.solve(matrix, change).reshape(n, 3)
    return count + 1, x + dt * v, v, x


def _internal(setting, x, x_before):
    """Forces [N] of membrane and bending, and minus their approximate derivative [N/m]."""
    mesh = setting.mesh
    laws = jax.vmap(setting.bending.at)(
        mesh.hinge_direction, mesh.hinge_bends.curvatures_at(x_before)
    )

    def of_face(*element):
        return _face(setting.membrane, *element)

    force = jnp.zeros(x.size)
    matrix = jnp.zeros((x.size, x.size))
    for elements, (forces, stiffness) in (
        (mesh.faces, jax.vmap(of_face)(x[mesh.faces], mesh.samples.gradients[:, 0], mesh.area)),
        (mesh.hinges, jax.vmap(_hinge)(x[mesh.hinges], laws, mesh.hinge_length, mesh.hinge_area)),
    ):
        axes = [3 * elements + axis for axis in range(3)]
        index = jnp.stack(axes, axis=-1).reshape(len(elements), -1)
        force = force.at[index].add(forces)
        matrix = matrix.at[index[:, :, None], index[:, None, :]].add(stiffness)
    return force, matrix


def _face(table, corners, shape, area):
    strain = green_strain(corners, shape)
    law = table.at(strain)
    stress, tangent = jax.grad(law.energy_density)(strain), jax.hessian(law.energy_density)(strain)
    jacobian = jax.jacfwd(green_strain)(corners, shape).reshape(3, 9)
    tension = (tangent @ jnp.maximum(strain, 0).at[2].set(0))[:2]
    geometric = jnp.kron(shape @ jnp.diag(tension) @ shape.T, jnp.eye(3))
    return -area * jacobian.T @ stress, area * (jacobian.T @ tangent @ jacobian + geometric)


def _hinge(corners, law, length, area):
    angle, gradient = jax.value_and_grad(hinge_angle)(corners)

    def energy(angle):
        return area * law.energy_density(angle * length / area)

    gradient = gradient.ravel()
    stiffness = jax.hessian(energy)(angle) * jnp.outer(gradient, gradient)
    return -jax.grad(energy)(angle) * gradient, stiffness


def wind_force(setting, v, x_before):
    """Force [N] of the air on the vertices, on the faces' rest areas."""
    mesh = setting.mesh
    corners = x_before[mesh.faces]
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    flow = setting.wind[None] - v[mesh.faces].mean(axis=1)
    across = jnp.sum(flow * normal, axis=1, keepdims=True)
    along = flow - across * normal
    pressure = setting.air_density * jnp.abs(across) * across * normal + setting.drag * along
    shares = jnp.broadcast_to((mesh.area[:, None] / 3 * pressure)[:, None], corners.shape)
    return jnp.zeros_like(v).at[mesh.faces].add(shares)
