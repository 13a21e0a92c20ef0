"""Motions in dynamic equilibrium, by Galerkin's method, and how they change with the fabric.

The network gives a motion close to the markers, but one that is not in equilibrium with any
stiffness. Here the motion is written in the virtual displacements, and corrected frame by frame
until it is (rates by BDF2 from rest, the inertia that of the network). So noise in the markers is
not taken for stress.

Newton's method in a frame is our own, with its tangent by hand and a line search:
`optimistix.Newton` takes 2.7 times the CPU seconds, `Dogleg` 4.2 times.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.weak_form import (
    Kinematics,
    Virtual,
    end_value,
    kinematics,
    load,
    marker_residual,
    nominal_stress,
    virtual_fields,
    virtual_work,
)
from r2s.materials.parameters import ParameterSpace

# weights of this frame and the two before in a rate, over the time between frames: at rest at first
FORMULAS = ((0.0, 0.0, 0.0), (1.0, -1.0, 0.0), (1.5, -2.0, 0.5))
NEWTON = 25  # most Newton steps in a frame
CUTS = 6  # lengths of a Newton step that are tried, each half of the one before
BALANCED = 1e-5  # work that may be left, over that of the stress


class Given(NamedTuple):
    """What the motion of a pull is corrected from.

    - `virtual`: the functions in which it is written, all but the last.
    - `even`: the even stretch from clamp to clamp, with the network's accelerations.
    - `markers`: differences of the even stretch from the markers, [m].
    """

    virtual: Virtual
    even: Kinematics
    markers: Float[Array, "frame marker axis"]


class Motion(NamedTuple):
    """A motion in equilibrium, with derivatives in the place in the parameter space.

    - `coefficients`: of the virtual displacements, [m].
    - `is_balanced`: whether each frame is in equilibrium. To the frames after one that is not, its
      derivative is that of the frame before.
    - `markers`: differences from the measured ones, [m]; zero where they are not seen.
    - `force`: on the far clamp, [N].
    """

    coefficients: Float[Array, "frame function axis"]
    is_balanced: Bool[Array, " frame"]
    markers: Float[Array, "frame marker axis"]
    markers_by_place: Float[Array, "frame marker axis dim"]
    force: Float[Array, " frame"]
    force_by_place: Float[Array, "frame dim"]


def prepare(
    network: Network, pull: Pull, degrees: tuple[int, int]
) -> tuple[Given, Float[Array, "frame function axis"]]:
    """What `equilibrium` needs of a network, and the coefficients [m] of the network's motion.

    `degrees`: of the virtual displacements, along and across the pull.
    """
    places = np.asarray(pull.places, np.float64) / np.asarray(pull.size, np.float64)
    return _prepared(network, pull, virtual_fields(degrees, markers=places))


@eqx.filter_jit
def _prepared(network: Network, pull: Pull, virtual: Virtual):
    even = eqx.tree_at(lambda n: n.scale, network, jnp.zeros_like(network.scale))
    frames = jnp.arange(len(pull.times))
    motion = kinematics(even, pull, virtual, frames)
    moving = kinematics(network, pull, virtual, frames)
    nodes = jnp.tile(virtual.nodes * pull.size[None], (len(frames), 1))
    times = jnp.repeat(pull.times, len(virtual.nodes))
    moved = network(jnp.concatenate([nodes, times[:, None]], axis=1))
    inverse = jnp.linalg.pinv(virtual.value[:-1].T)
    start = jnp.einsum("fq,tqi->tfi", inverse, moved.reshape(motion.velocity.shape))
    motion = motion._replace(acceleration=moving.acceleration)
    return Given(virtual, motion, marker_residual(even, pull)), start


@eqx.filter_jit
def equilibrium(
    space: ParameterSpace,
    place: Float[Array, " dim"],
    pull: Pull,
    given: Given,
    start: Float[Array, "frame function axis"],
) -> Motion:
    """The motion in equilibrium at a place of the parameter space.

    Newton's method begins with the coefficients `start` [m], or with those of the frame before
    where they are nearer to equilibrium.
    """
    virtual, axes = given.virtual, start.shape[2]
    interval = (pull.times[-1] - pull.times[0]) / (len(pull.times) - 1)
    formulas = np.array([FORMULAS[min(frame, 2)] for frame in range(len(start))])

    def of_frame(carried, frame):
        (before, earlier), (slope_before, slope_earlier) = carried
        even, guess, formula = frame
        even = jax.tree.map(lambda values: values[None], even)

        def works(now, place=place):
            rate = formula[0] * now + formula[1] * before + formula[2] * earlier
            moved = _moved(even, pull, virtual, now, rate)
            return virtual_work(space(place), pull, virtual, moved)[0], moved

        now, is_balanced = _newton(works, space(place), pull, virtual, formula[0], before, guess)
        work, moved = works(now)
        by_now, by_rate = _tangents(space(place), pull, virtual, moved)
        matrix = by_now + formula[0] * by_rate
        by_place = jax.jacfwd(lambda place: works(now, place)[0].ravel())(place)
        past = formula[1] * slope_before + formula[2] * slope_earlier
        right = by_place + by_rate @ past
        slope = -jnp.linalg.solve(matrix[:-axes], right[:-axes])
        slope = jnp.where(is_balanced, slope, slope_before)
        force_slope = matrix[-axes] @ slope + right[-axes]
        found = now, is_balanced, slope, work[-1, 0], force_slope
        return ((now, before), (slope, slope_before)), found

    none = jnp.zeros((start[0].size, len(place)), start.dtype)
    frames = given.even, start, jnp.asarray(formulas, float) / interval
    _, found = jax.lax.scan(of_frame, ((start[0], start[0]), (none, none)), frames)
    now, is_balanced, slope, force, force_by_place = found
    markers = given.markers + jnp.einsum("mf,tfi->tmi", virtual.at_markers, now)
    by_place = jnp.einsum("mf,tfid->tmid", virtual.at_markers, slope.reshape(*now.shape, -1))
    seen, at_end = pull.seen[..., None], end_value(virtual)
    markers, by_place = jnp.where(seen, markers, 0), jnp.where(seen[..., None], by_place, 0)
    return Motion(now, is_balanced, markers, by_place, force / at_end, force_by_place / at_end)


def _moved(even: Kinematics, pull: Pull, virtual: Virtual, now: Array, rate: Array) -> Kinematics:
    """The motion in one frame, from coefficients [m] and rates [m/s]; its axis of frames is 1."""
    slope = virtual.slope[:-1] / pull.size[None, None]
    change, change_rate = (jnp.einsum("fi,fqj->qij", c, slope)[None] for c in (now, rate))
    velocity = even.velocity + jnp.einsum("fi,fq->qi", rate, virtual.value[:-1])[None]
    return Kinematics(even.gradient + change, even.rate + change_rate, velocity, even.acceleration)


def _tangents(fabric, pull: Pull, virtual: Virtual, motion: Kinematics):
    """Derivatives of the work in one frame, in the coefficients and in their rates."""

    def stress(gradient, rate):
        return nominal_stress(fabric, pull.angle, gradient, rate)

    def load_at(velocity, acceleration):
        return load(fabric, pull, velocity, acceleration)

    by_gradient, by_rate = jax.vmap(jax.jacfwd(stress, (0, 1)))(motion.gradient[0], motion.rate[0])
    by_velocity = jax.vmap(jax.jacfwd(load_at))(motion.velocity[0], motion.acceleration[0])
    weights = virtual.weights * pull.size[0] * pull.size[1]
    slope, value = virtual.slope / pull.size[None, None], virtual.value

    def strains(tangent):  # in two steps, or it would be many times the work
        inner = jnp.einsum("q,qikjl,gql->qikgj", weights, tangent, slope[:-1])
        return jnp.einsum("fqk,qikgj->figj", slope, inner)

    moves = jnp.einsum("q,fq,qij,gq->figj", weights, value, by_velocity, value[:-1])
    size = slope.shape[0] * motion.velocity.shape[2]
    by_now, by_rate = strains(by_gradient), strains(by_rate) + moves
    return by_now.reshape(size, -1), by_rate.reshape(size, -1)


def _newton(works, fabric, pull: Pull, virtual: Virtual, rate, before, guess):
    """Coefficients of a frame in equilibrium, and whether they are.

    - `works`: the work at coefficients, and their motion.
    - `rate`: derivative of the rate in them, [1/s].
    - `before`, `guess`: coefficients to begin with, of which the better ones are taken.
    """

    def size(now):
        return jnp.linalg.norm(works(now)[0][:-1])

    # the stress of the even motion, for want of another measure
    enough = BALANCED * (jnp.linalg.norm(works(guess)[0][-1]) + jnp.max(pull.size) * 0.1)

    def goes_on(state):
        _, left, count = state
        return (left > enough) & (count < NEWTON)

    def improve(state):
        now, left, count = state
        work, moved = works(now)
        by_now, by_rate = _tangents(fabric, pull, virtual, moved)
        matrix = (by_now + rate * by_rate)[: -now.shape[1]]
        step = -jnp.linalg.solve(matrix, work[:-1].ravel()).reshape(now.shape)
        shares = 0.5 ** jnp.arange(CUTS, dtype=now.dtype)
        sizes = jax.vmap(lambda share: size(now + share * step))(shares)
        best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
        is_better = sizes[best] < left
        now = jnp.where(is_better, now + shares[best] * step, now)
        return now, jnp.minimum(sizes[best], left), jnp.where(is_better, count + 1, NEWTON)

    guess = jnp.where(size(guess) < size(before), guess, before)
    now, left, _ = jax.lax.while_loop(goes_on, improve, (guess, size(guess), 0))
    return now, left < 100 * enough
