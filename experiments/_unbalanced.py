"""What clouds tell of a fabric when a map of the motion obeys the equation of motion but nearly.

An extended Kalman filter about the exact motion: its state are places and velocities, the fabric's
place in its space, and unbalanced accelerations that nothing explains. What it knows of the fabric
at the end is the most that an unbiased estimate beside such a map can know (Jazwinski 1970).
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.linalg import solve

import r2s
from r2s.cloth.cloth import ClothState
from r2s.scenarios.scenario import Braked, begin, stepped
from r2s.units import GRAVITY

CHUNK = 64  # tangents at once
KNOWN = 1e-9  # [m], [m/s]: standard error of what is known


class Linear(NamedTuple):
    """About the exact motion: by frame, of all that moves in places, fabric and accelerations.

    - `start`: derivative of the first frame's state in the fabric.
    - `state`, `fabric`, `push`: of a frame's state in that before, the fabric, and accelerations.
    - `normal`: unit normals of the vertices.
    """

    start: Float[np.ndarray, "state dim"]
    state: Float[np.ndarray, "frame state state"]
    fabric: Float[np.ndarray, "frame state dim"]
    push: Float[np.ndarray, "frame state acceleration"]
    normal: Float[np.ndarray, "frame vertex 3"]


def linear(
    scenario: r2s.Scenario, space: r2s.ParameterSpace, place: Float[Array, " dim"]
) -> Linear:
    """The motion of the fabric at a place of a space, and its derivatives, frame by frame."""
    solver, substeps = stepped(scenario)
    controls, lead_in = scenario.controls(substeps), scenario.lead_in
    cloth = solver.solver if isinstance(solver, Braked) else solver
    before, after = (
        jax.tree.map(lambda leaf, part=part: leaf[part], controls)
        for part in (slice(None, lead_in), slice(lead_in, None))
    )

    def led_in(place):
        def step(state, control):
            return solver.step(space(place), state, control), None

        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), before)
        state, _ = jax.lax.scan(step, begin(solver, scenario), flat)
        return _packed(state.inner if isinstance(solver, Braked) else state)

    def framed(numbers, control):
        packed, place, push = numbers
        fabric, push = space(place), push.reshape(-1, 3)

        def step(state, control):
            # of BDF2's momentum, where a velocity counts by 4/3 and an acceleration by 2/3 dt
            pushed = dataclasses.replace(state, v=state.v + cloth.dt / 2 * push)
            after = cloth.step(fabric, pushed, control)
            return dataclasses.replace(after, v_before=state.v), None

        return _packed(jax.lax.scan(step, _unpacked(packed), control)[0])

    @eqx.filter_jit
    def frame(packed, control):
        nothing = jnp.zeros(packed.shape[0] // 4, packed.dtype)
        flat, unravel = ravel_pytree((packed, place, nothing))

        def along(tangent):
            move = partial(framed, control=control)
            return jax.jvp(move, (unravel(flat),), (unravel(tangent),))[1]

        slopes = jax.lax.map(along, jnp.eye(len(flat), dtype=flat.dtype), batch_size=CHUNK)
        return framed(unravel(flat), control), slopes.T

    packed, start = eqx.filter_jit(led_in)(place), eqx.filter_jit(jax.jacfwd(led_in))(place)
    slopes, normals, size = [], [], len(packed)
    for number in range(scenario.num_frames - 1):
        control = jax.tree.map(lambda leaf, number=number: leaf[number], after)
        packed, slope = frame(packed, control)
        if not np.isfinite(packed).all():
            raise RuntimeError(f"the motion is not finite from frame {number + 1} on")
        slopes.append(np.asarray(slope))
        normals.append(_normals(scenario, np.asarray(_unpacked(packed).x)))
    whole, dim = np.stack(slopes), len(place)
    parts = whole[..., :size], whole[..., size : size + dim], whole[..., size + dim :]
    return Linear(np.asarray(start), *parts, np.stack(normals))


def known(
    motion: Linear, precision: Float[np.ndarray, "dim dim"], noise: float, share: float, lasts: bool
) -> Float[np.ndarray, " dim"]:
    """Standard errors of the fabric's place at the end of a motion.

    - `precision`: of what is known of the place beforehand.
    - `noise`: of what is seen of each vertex along its normal in each frame, [m].
    - `share`: unbalanced accelerations over gravity, root mean square, [-]: of every vertex and
      axis for itself; in each frame anew, or, where it `lasts`, the same in all.
    """
    size, dim, pushes = motion.state.shape[-1], motion.fabric.shape[-1], motion.push.shape[-1]
    spread = (share * GRAVITY) ** 2
    of_place = np.linalg.inv(precision)
    lead = np.vstack([motion.start, np.eye(dim), np.zeros((pushes, dim))])
    covariance = lead @ of_place @ lead.T
    covariance[:size, :size] += KNOWN**2 * np.eye(size)
    if lasts:
        covariance[size + dim :, size + dim :] = spread * np.eye(pushes)
    for state, fabric, push, normal in zip(*motion[1:], strict=True):
        moves = np.eye(size + dim + pushes)
        moves[:size] = np.hstack([state, fabric, push if lasts else np.zeros_like(push)])
        covariance = moves @ covariance @ moves.T
        if not lasts:
            covariance[:size, :size] += spread * push @ push.T
        covariance = _seen(covariance, normal, noise)
    return np.sqrt(np.diag(covariance)[size : size + dim])


def _seen(
    covariance: Float[np.ndarray, "all all"], normal: Float[np.ndarray, "vertex 3"], noise: float
) -> Float[np.ndarray, "all all"]:
    """A covariance once every vertex was seen along its normal."""
    count = len(normal)
    looks = np.zeros((count, len(covariance)))
    for axis in range(3):
        looks[np.arange(count), 3 * np.arange(count) + axis] = normal[:, axis]
    shared = covariance @ looks.T
    gain = solve(looks @ shared + noise**2 * np.eye(count), shared.T, assume_a="pos").T
    kept = np.eye(len(covariance)) - gain @ looks  # Joseph's form stays positive
    return kept @ covariance @ kept.T + noise**2 * gain @ gain.T


def _packed(state: ClothState) -> Float[Array, " state"]:
    parts = state.x, state.v, state.x_before, state.v_before
    return jnp.concatenate([part.ravel() for part in parts])


def _unpacked(packed: Float[Array, " state"]) -> ClothState:
    return ClothState(*(part.reshape(-1, 3) for part in jnp.split(packed, 4)))


def _normals(
    scenario: r2s.Scenario, x: Float[np.ndarray, "vertex 3"]
) -> Float[np.ndarray, "vertex 3"]:
    """Unit normals of the vertices: of the triangles around each, by their areas."""
    faces = np.asarray(scenario.scene.mesh.faces)
    edges = x[faces[:, 1:]] - x[faces[:, :1]]
    total = np.zeros_like(x)
    for corner in faces.T:
        np.add.at(total, corner, np.cross(edges[:, 0], edges[:, 1]))
    return total / np.linalg.norm(total, axis=1, keepdims=True)
