"""A pull's motion, its stress, the weak form (work in virtual displacements), and equilibrium.

The displacement is the network's plus the even stretch between the clamps. The sheet has sides X
(the pull) and Y; the law is in the axes of warp and weft, which are turned by an angle from X.
Stress is force per width [N/m]: no thickness enters.

The virtual displacements vanish at the clamps. They do not at the free edges, so that their balance
makes the traction there zero. One more grows evenly from clamp to clamp and gives the balance with
the measured force. First derivatives in space suffice. For a given motion the work is linear in the
stiffness (virtual fields method: Pierron and Grediac 2012).

The network's motion is close to the markers, but in equilibrium with no stiffness. By Galerkin's
method it is written in the virtual displacements, and corrected frame by frame until it is in
equilibrium (rates by BDF2 from rest, the inertia that of the network). So noise in the markers is
not taken for stress. Newton's method in a frame is our own, with its tangent by hand and a line
search: `optimistix.Newton` takes 2.7 times the CPU seconds, `Dogleg` 4.2 times.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.polynomial import Legendre, Polynomial

from r2s.environment.contact import friction_dissipation
from r2s.estimation.pinn.network import Jet, Network, Pairs, T, X, Y
from r2s.estimation.pinn.pulls import Pull
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import TurnedMembrane
from r2s.materials.parameters import ParameterSpace

EDGE_NODES = 6  # of Gauss's quadrature along a clamp
NODES = 12  # of the quadrature along each side
DEGREES = (7, 8)  # number of polynomials along and across the pull
# weights of this frame and the two before in a rate, over the time between frames: at rest at first
FORMULAS = ((0.0, 0.0, 0.0), (1.0, -1.0, 0.0), (1.5, -2.0, 0.5))
NEWTON = 25  # most Newton steps in a frame
CUTS = 6  # lengths of a Newton step that are tried, each half of the one before
BALANCED = 1e-5  # work that may be left, over that of the stress

Gradient = Float[Array, "axis 2"]  # of displacement in X and Y, [-]
Voigt = Float[Array, " 3"]  # strain (E11, E22, 2 E12) [-]


# Displacement


def field(
    network: Network,
    pull: Pull,
    places: Float[Array, "point 2"],
    frames: Int[Array, " point"],
    pairs: Pairs,
) -> Jet:
    """Displacements [m] at places (X, Y) [m] in frames, with second derivatives in `pairs`."""
    jet = network.jet(_inputs(pull, places, frames), pairs)
    share = (places[:, 0] / pull.size[0])[:, None]
    near, far = ([part[frames] for part in clamp] for clamp in (pull.near, pull.far))
    value, rate, acceleration = (n + share * (f - n) for n, f in zip(near, far, strict=True))
    slope, slope_rate = ((f - n) / pull.size[0] for f, n in zip(far[:2], near[:2], strict=True))
    even = {(0, T): slope_rate, (T, T): acceleration}
    added = [even.get(pair, jnp.zeros_like(value)) for pair in pairs]
    first = jet.first + jnp.stack([slope, jnp.zeros_like(slope), rate])
    return Jet(jet.value + value, first, jet.second + jnp.stack(added))


def displacement(
    network: Network,
    pull: Pull,
    places: Float[Array, "point 2"],
    frames: Int[Array, " point"],
) -> Float[Array, "point axis"]:
    """Displacements [m], see `field`, without derivatives."""
    share = (places[:, 0] / pull.size[0])[:, None]
    near, far = pull.near.value[frames], pull.far.value[frames]
    return network(_inputs(pull, places, frames)) + near + share * (far - near)


def _inputs(pull: Pull, places, frames) -> Float[Array, "point 3"]:
    return jnp.concatenate([places, pull.times[frames][:, None]], axis=1)


def marker_residual(network: Network, pull: Pull) -> Float[Array, "frame marker axis"]:
    """Differences [m] of the network from the markers; zero where they are not seen."""
    number, markers, axes = pull.displacement.shape
    places = jnp.tile(pull.places, (number, 1))
    moved = displacement(network, pull, places, jnp.repeat(jnp.arange(number), markers))
    difference = moved.reshape(number, markers, axes) - pull.displacement
    return jnp.where(pull.seen[..., None], difference, 0)


def clamp_residual(network: Network, pull: Pull) -> Float[Array, "point axis"]:
    """Differences [m] of the network from both clamps, at nodes along them in every frame."""
    nodes = jnp.asarray((np.polynomial.legendre.leggauss(EDGE_NODES)[0] + 1) / 2, float)
    number = len(pull.times)
    y = jnp.tile(nodes * pull.size[1], 2 * number)
    frames = jnp.repeat(jnp.arange(number), 2 * EDGE_NODES)
    ends = jnp.tile(jnp.repeat(jnp.array([0.0, 1.0], y.dtype), EDGE_NODES), number)
    places = jnp.stack([ends * pull.size[0], y], axis=1)
    clamp = jnp.where(ends[:, None] > 0, pull.far.value[frames], pull.near.value[frames])
    return displacement(network, pull, places, frames) - clamp


# Stress and load


def green_strain(gradient: Gradient) -> Voigt:
    """Green strain [-] of a gradient of displacement, exact for any rotation."""
    f = gradient + jnp.eye(2, dtype=gradient.dtype)
    return jnp.stack([(f[:, 0] @ f[:, 0] - 1) / 2, (f[:, 1] @ f[:, 1] - 1) / 2, f[:, 0] @ f[:, 1]])


def small_strain(gradient: Gradient) -> Voigt:
    """Small strain [-] of a gradient of displacement, with the engineering shear."""
    return jnp.stack([gradient[0, 0], gradient[1, 1], gradient[0, 1] + gradient[1, 0]])


def nominal_stress(
    fabric: Fabric,
    angle: Float[Array, ""],
    gradient: Gradient,
    rate: Gradient | None = None,
    strain: Callable[[Gradient], Voigt] = green_strain,
) -> Gradient:
    """First Piola-Kirchhoff stress [N/m], the derivative of the energy in the gradient.

    Its first column is the traction on an edge across X, per width at rest. In Green strain it is
    F S, in small strain the symmetric stress.

    - `angle`: from X to the warp, [rad].
    - `gradient`: of the displacement, [-].
    - `rate`: of the gradient [1/s]; adds Kelvin-Voigt damping.
    - `strain`: `green_strain` or `small_strain`.
    """
    energy = TurnedMembrane(fabric.membrane, angle).energy_density
    at, pull_back = jax.vjp(strain, gradient)
    if rate is not None:
        at = at + fabric.damping * jax.jvp(strain, (gradient,), (rate,))[1]
    return pull_back(jax.grad(energy)(at))[0]


def load(
    fabric: Fabric,
    pull: Pull,
    velocity: Float[Array, " axis"],
    acceleration: Float[Array, " axis"],
) -> Float[Array, " axis"]:
    """Load [N/m^2] that the stress must balance: inertia, damping and friction, less the weight.

    The friction is that of the cloth solver on a table (`r2s.environment.contact`).
    """
    limit = fabric.friction * fabric.density * pull.normal
    friction = jax.grad(friction_dissipation, argnums=1)(limit, velocity)
    damped = acceleration + fabric.mass_damping * velocity - pull.gravity
    return fabric.density * damped + friction


# Virtual work


class Virtual(NamedTuple):
    """Virtual displacements on the unit square, at the nodes of a quadrature.

    The last one grows evenly from clamp to clamp; the others vanish at both.

    - `nodes`, `weights`: of the quadrature.
    - `value`, `slope`: of the functions, and in both sides, [-].
    - `at_markers`: value of all but the last function at the markers, [-].
    """

    nodes: Float[Array, "node 2"]
    weights: Float[Array, " node"]
    value: Float[Array, "function node"]
    slope: Float[Array, "function node 2"]
    at_markers: Float[Array, "marker function"]


def virtual_fields(
    degrees: tuple[int, int] = DEGREES,
    nodes: int = NODES,
    markers: Float[np.ndarray, "marker 2"] | None = None,
) -> Virtual:
    """Products x (1 - x) P_i(x) P_j(y) of Legendre polynomials, scaled to a mean slope of 1.

    - `degrees`: number of polynomials along and across the pull.
    - `nodes`: of the quadrature along each side. - `markers`: places on the unit square.
    """
    at, weight = np.polynomial.legendre.leggauss(nodes)
    places = np.stack(np.meshgrid((at + 1) / 2, (at + 1) / 2, indexing="ij"), -1).reshape(-1, 2)
    weights = np.outer(weight, weight).ravel() / 4

    def legendre(degree: int) -> Polynomial:
        return Legendre.basis(degree, [0, 1]).convert(kind=Polynomial)

    def values(functions, places) -> np.ndarray:
        x, y = places.T
        return np.array([f(x) * g(y) for f, g in functions])

    along, across = ([legendre(i) for i in range(count)] for count in degrees)
    pairs = [(f * Polynomial([0, 1, -1]), g) for f in along for g in across]
    pairs.append((Polynomial([0, 1]), Polynomial([1])))
    slopes = [values([(f.deriv(), g) for f, g in pairs], places)]
    slopes.append(values([(f, g.deriv()) for f, g in pairs], places))
    slope = np.stack(slopes, axis=2)
    size = np.sqrt(np.einsum("fqi,q->f", slope**2, weights))[:, None]
    at_markers = values(pairs, np.zeros((0, 2)) if markers is None else markers) / size
    parts = places, weights, values(pairs, places) / size, slope / size[..., None]
    return Virtual(*(jnp.asarray(part, float) for part in (*parts, at_markers[:-1].T)))


class Kinematics(NamedTuple):
    """A motion at the nodes of a quadrature.

    - `gradient`, `rate`: of the displacement [-] and its rate [1/s].
    - `velocity`, `acceleration`: [m/s], [m/s^2].
    """

    gradient: Float[Array, "frame node axis 2"]
    rate: Float[Array, "frame node axis 2"]
    velocity: Float[Array, "frame node axis"]
    acceleration: Float[Array, "frame node axis"]


def kinematics(
    network: Network, pull: Pull, virtual: Virtual, frames: Int[Array, " frame"]
) -> Kinematics:
    """The motion of a network at the nodes in some frames."""
    number, nodes = len(frames), len(virtual.nodes)
    places = jnp.tile(virtual.nodes * pull.size[None], (number, 1))
    jet = field(network, pull, places, jnp.repeat(frames, nodes), ((X, T), (Y, T), (T, T)))
    rate = jnp.moveaxis(jet.second[:2], 0, -1)
    parts = jet.gradient, rate, jet.first[T], jet.second[2]
    return Kinematics(*(part.reshape(number, nodes, *part.shape[1:]) for part in parts))


def virtual_work(
    fabric: Fabric, pull: Pull, virtual: Virtual, motion: Kinematics
) -> Float[Array, "frame function axis"]:
    """Work [N m / m] of stress and load in every virtual displacement and frame.

    In balance it is zero for all but the last one. There it is the force on the far clamp [N] times
    the value of that displacement at the clamp, see `end_value`.
    """

    def stresses(gradient, rate, velocity, acceleration):
        stress = nominal_stress(fabric, pull.angle, gradient, rate)
        return stress, load(fabric, pull, velocity, acceleration)

    stress, loads = jax.vmap(jax.vmap(stresses))(*motion)
    weights = virtual.weights * pull.size[0] * pull.size[1]
    slope = virtual.slope / pull.size[None, None]
    inner = jnp.einsum("q,tqij,fqj->tfi", weights, stress, slope)
    return inner + jnp.einsum("q,tqi,fq->tfi", weights, loads, virtual.value)


def end_value(virtual: Virtual) -> Float[Array, ""]:
    """Value [-] of the last virtual displacement at the far clamp."""
    return virtual.slope[-1, 0, 0]


# Equilibrium


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

    def of_frame(carry, frame):
        (before, earlier), (slope_before, slope_earlier) = carry
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
        solution = now, is_balanced, slope, work[-1, 0], force_slope
        return ((now, before), (slope, slope_before)), solution

    none = jnp.zeros((start[0].size, len(place)), start.dtype)
    frames = given.even, start, jnp.asarray(formulas, float) / interval
    _, solution = jax.lax.scan(of_frame, ((start[0], start[0]), (none, none)), frames)
    now, is_balanced, slope, force, force_by_place = solution
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
    """Coefficients of a frame in equilibrium, and whether they are; from the better ones of the
    frame `before` and the `guess`. `rate`: derivative of the rate in the coefficients, [1/s]."""

    def size(now):
        return jnp.linalg.norm(works(now)[0][:-1])

    enough = BALANCED * (jnp.linalg.norm(works(guess)[0][-1]) + jnp.max(pull.size) * 0.1)

    def is_unfinished(state):
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
    now, left, _ = jax.lax.while_loop(is_unfinished, improve, (guess, size(guess), 0))
    return now, left < 100 * enough
