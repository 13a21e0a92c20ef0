"""The estimate from the weak form: motions in balance, and the stiffness that fits them best.

The network gives a motion close to the markers, but one that need not be in balance with any
stiffness. Here the motion is written in the virtual displacements, and corrected frame by frame
until it is in balance (Galerkin's method; rates by BDF2 from rest, the inertia that of the
network). How the motion in balance changes with the stiffness gives Gauss-Newton steps to the
stiffness that fits markers and force best, and its covariance. So noise in the markers is not taken
for stress.

The Gauss-Newton loop is our own beside optimistix, which has no bounds, begins each motion anew and
cannot estimate the noise along: from three pulls `optimistix.LevenbergMarquardt` arrives at the
same place, to 0.05 standard errors, in 34 steps and 71 CPU seconds, and `Dogleg`, to 0.16, in 23
steps and 49 CPU seconds, where this takes 7 steps and 12 CPU seconds. Newton's method in a frame is
our own too, with its tangent by hand and shares of a step: `optimistix.Newton` takes 2.7 times the
CPU seconds (1.59 against 0.59 for 39 frames, in 144 steps against 124), `Dogleg` 4.2 times.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.estimation.law_error import to_small_strain
from r2s.estimation.pinn.losses import load, marker_residual
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import Strain, green, nominal_stress
from r2s.estimation.pinn.weak_form import (
    DEGREES,
    Kinematics,
    Virtual,
    end_value,
    kinematics,
    virtual_at,
    virtual_fields,
    virtual_work,
)
from r2s.fabrics.parameters import ParameterSpace
from r2s.fabrics.stiffening_space import stiffens

# weights of this frame and the two before in a rate, over the time between frames: at rest at first
FORMULAS = ((0.0, 0.0, 0.0), (1.0, -1.0, 0.0), (1.5, -2.0, 0.5))
NEWTON = 25  # most Newton steps in a frame
CUTS = 6  # lengths of a Newton step that are tried, each half of the one before
BALANCED = 1e-5  # work that may be left, over that of the stress
LONGEST = 0.1  # Gauss-Newton step, of a range
INSIDE = 1e-3  # least distance from the ends of the ranges
FLAT_PRIOR = 12.0  # one over the variance of a uniform distribution on 0..1
STEPS = 60  # most Gauss-Newton steps
SMALL = 0.05  # of the standard errors: the Gauss-Newton step after which it has converged
LEAST_NOISE = (1e-7, 1e-5)  # of markers [m], and of the force over its greatest [-]

Coefficients = Float[Array, "function axis"]  # of virtual displacements, [m]


class Basis(NamedTuple):
    """Functions in which a motion is written, beside the even stretch from clamp to clamp.

    - `virtual`: the functions at the nodes of the quadrature.
    - `at_markers`: all but the last one, at the markers, [-].
    """

    virtual: Virtual
    at_markers: Float[Array, "marker function"]


class Solved(NamedTuple):
    """The motion of one pull in balance, and derivatives of the imbalance in every frame.

    The last two rows of a derivative (one for each axis) are of the force.

    - `coefficients`: of the motion, [m].
    - `balanced`: whether each frame is in balance.
    - `by_now`, `by_rate`: derivatives in the coefficients and in their rates.
    - `by_place`: derivatives in the place in the parameter space.
    - `markers`: differences from the measured ones [m].
    - `force`: on the clamp [N].
    """

    coefficients: Float[Array, "frame function axis"]
    balanced: Bool[Array, " frame"]
    by_now: Float[Array, "frame work coefficient"]
    by_rate: Float[Array, "frame work coefficient"]
    by_place: Float[Array, "frame work dim"]
    markers: Float[Array, "frame marker axis"]
    force: Float[Array, " frame"]


class Reduced(NamedTuple):
    """Differences of markers [m] and force [N] from the measured ones, and derivatives in the place
    in the parameter space; of the frames that are in balance.

    - `counts`: whether each frame is.
    """

    markers: np.ndarray
    markers_by_place: np.ndarray
    force: np.ndarray
    force_by_place: np.ndarray
    counts: Bool[np.ndarray, " frame"]

    @property
    def is_complete(self) -> bool:
        """Whether all frames are in balance."""
        return bool(self.counts.all())

    def where(self, chosen: Bool[np.ndarray, " frame"]) -> "Reduced":
        """Of some of the frames alone."""
        kept = chosen[self.counts]
        rows = np.repeat(kept, len(self.markers) // max(len(kept), 1))
        each = self.markers[rows], self.markers_by_place[rows]
        return Reduced(*each, self.force[kept], self.force_by_place[kept], self.counts & chosen)


class Balanced(NamedTuple):
    """What the weak form found.

    - `place`: in the space's unit cube.
    - `covariance`: of that place.
    - `marker`, `force`: rms differences that are left, of markers [m] and force [-].
    - `places`, `losses`: of every step; the losses are mean squares of the markers' rest [m^2].
    - `converged`: whether the last step was small.
    - `law`: what the covariance lacks where stiffness is not constant, see `_law_error`; zero for
      spaces of yarns that stiffen.
    """

    place: Float[np.ndarray, " dim"]
    covariance: Float[np.ndarray, "dim dim"]
    marker: float
    force: float
    places: Float[np.ndarray, "step dim"]
    losses: Float[np.ndarray, " step"]
    converged: bool
    law: Float[np.ndarray, "dim dim"]


def basis_of(pull: Pull, degrees: tuple[int, int] = DEGREES) -> Basis:
    """The functions for one pull, of some degrees along and across it."""
    virtual = virtual_fields(degrees)
    nodes, weights = (np.asarray(part, np.float64) for part in virtual[:2])
    _, slope = virtual_at(nodes, degrees)
    scale = np.sqrt(np.einsum("fqi,q->f", slope**2, weights))
    places = np.asarray(pull.places, np.float64) / np.asarray(pull.size, np.float64)
    at, _ = virtual_at(places, degrees)
    return Basis(virtual, jnp.asarray((at / scale[:, None])[:-1].T, float))


@eqx.filter_jit
def prepared(network: Network, pull: Pull, basis: Basis):
    """What `solve` begins with.

    Returns the even stretch with the network's accelerations, its differences from the markers [m],
    and the coefficients of the network's motion in every frame [m].
    """
    even = eqx.tree_at(lambda n: n.scale, network, jnp.zeros_like(network.scale))
    frames = jnp.arange(len(pull.times))
    motion = kinematics(even, pull, basis.virtual, frames)
    moving = kinematics(network, pull, basis.virtual, frames)
    nodes = jnp.tile(basis.virtual.nodes * pull.size[None], (len(frames), 1))
    times = jnp.repeat(pull.times, len(basis.virtual.nodes))
    moved = network(jnp.concatenate([nodes, times[:, None]], axis=1))
    moved = moved.reshape(motion.velocity.shape)
    inverse = jnp.linalg.pinv(basis.virtual.value[:-1].T)
    start = jnp.einsum("fq,tqi->tfi", inverse, moved)
    return motion._replace(acceleration=moving.acceleration), marker_residual(even, pull), start


def _moved(
    even: Kinematics, pull: Pull, basis: Basis, now: Coefficients, rate: Coefficients
) -> Kinematics:
    """The motion in one frame, from coefficients and their rates [m/s]; its axis of frames is 1."""
    slope = basis.virtual.slope[:-1] / pull.size[None, None]
    change = jnp.einsum("fi,fqj->qij", now, slope)[None]
    change_rate = jnp.einsum("fi,fqj->qij", rate, slope)[None]
    velocity = jnp.einsum("fi,fq->qi", rate, basis.virtual.value[:-1])[None]
    return Kinematics(
        even.gradient + change,
        even.rate + change_rate,
        even.velocity + velocity,
        even.acceleration,
    )


def _tangents(fabric, pull: Pull, basis: Basis, motion: Kinematics, strain: Strain):
    """Derivatives of the work in one frame, in the coefficients and in their rates."""

    def stress(gradient, rate):
        return nominal_stress(fabric, pull.angle, gradient, rate, strain)

    def load_at(velocity, acceleration):
        return load(fabric, pull, velocity, acceleration)

    by_gradient, by_rate = jax.vmap(jax.jacfwd(stress, (0, 1)))(motion.gradient[0], motion.rate[0])
    by_velocity = jax.vmap(jax.jacfwd(load_at))(motion.velocity[0], motion.acceleration[0])
    weights = basis.virtual.weights * pull.size[0] * pull.size[1]
    slope, value = basis.virtual.slope / pull.size[None, None], basis.virtual.value

    def strains(tangent):  # in two steps, or it would be many times the work
        inner = jnp.einsum("q,qikjl,gql->qikgj", weights, tangent, slope[:-1])
        return jnp.einsum("fqk,qikgj->figj", slope, inner)

    moves = jnp.einsum("q,fq,qij,gq->figj", weights, value, by_velocity, value[:-1])
    size = slope.shape[0] * motion.velocity.shape[2]
    by_now, by_rate = strains(by_gradient), strains(by_rate) + moves
    return by_now.reshape(size, -1), by_rate.reshape(size, -1)


@eqx.filter_jit
def solve(
    space: ParameterSpace,
    place: Float[Array, " dim"],
    pull: Pull,
    basis: Basis,
    even: Kinematics,
    off: Float[Array, "frame marker axis"],
    start: Float[Array, "frame function axis"],
    strain: Strain = green,
) -> Solved:
    """The motion in balance at a place of the parameter space, with derivatives.

    - `even`, `off`, `start`: see `prepared`. Newton's method begins with the coefficients `start`,
      or with those of the frame before where they are nearer to balance.
    """
    fabric, interval = space(place), (pull.times[-1] - pull.times[0]) / (len(pull.times) - 1)
    shape, axes = start.shape[1:], start.shape[2]

    def frame_in_balance(carried, given):
        before, earlier = carried
        frame, guess, formula = given
        frame = jax.tree.map(lambda values: values[None], frame)

        def works(now, fabric=fabric):
            rate = formula[0] * now + formula[1] * before + formula[2] * earlier
            moved = _moved(frame, pull, basis, now, rate)
            return virtual_work(fabric, pull, basis.virtual, moved, strain)[0], moved

        def size(now):
            return jnp.linalg.norm(works(now)[0][:-1])

        def of_place(place):
            return works(now, space(place))[0].ravel()

        # the stress of the even motion, for want of another measure
        enough = BALANCED * jnp.linalg.norm(works(guess)[0][-1])
        floor = BALANCED * jnp.max(pull.size) * 0.1

        def goes_on(state):
            _, left, count = state
            return (left > enough + floor) & (count < NEWTON)

        def improve(state):
            now, left, count = state
            work, moved = works(now)
            by_now, by_rate = _tangents(fabric, pull, basis, moved, strain)
            matrix = (by_now + formula[0] * by_rate)[:-axes]
            step = -jnp.linalg.solve(matrix, work[:-1].ravel()).reshape(shape)
            shares = 0.5 ** jnp.arange(CUTS, dtype=now.dtype)
            sizes = jax.vmap(lambda share: size(now + share * step))(shares)
            best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
            better = sizes[best] < left
            now = jnp.where(better, now + shares[best] * step, now)
            return now, jnp.minimum(sizes[best], left), jnp.where(better, count + 1, NEWTON)

        guess = jnp.where(size(guess) < size(before), guess, before)
        now, left, _ = jax.lax.while_loop(goes_on, improve, (guess, size(guess), 0))
        work, moved = works(now)
        tangents = _tangents(fabric, pull, basis, moved, strain)
        good = left < 100 * (enough + floor)
        return (now, before), (now, good, *tangents, jax.jacfwd(of_place)(place), work[-1, 0])

    given = even, start, jnp.asarray(_formulas(len(start)), float) / interval
    _, found = jax.lax.scan(frame_in_balance, (start[0], start[0]), given)
    now, good, by_now, by_rate, by_place, force = found
    markers = off + jnp.einsum("mf,tfi->tmi", basis.at_markers, now)
    markers = jnp.where(pull.seen[..., None], markers, 0)
    force = force / end_value(basis.virtual)
    return Solved(now, good, by_now, by_rate, by_place, markers, force)


def reduced(solved: Solved, pull: Pull, basis: Basis) -> Reduced:
    """Markers and force in balance, with their derivatives through all frames.

    A frame that is not in balance has no derivative, which may come out as anything: it does not
    count, and to those after it its derivative is that of the frame before.
    """
    parts = (np.asarray(part, np.float64) for part in solved[2:5])
    number, axes = len(pull.times), solved.markers.shape[2]
    interval = float(pull.times[-1] - pull.times[0]) / (number - 1)
    dim = solved.by_place.shape[2]
    slopes = [np.zeros((solved.by_now.shape[2], dim))] * 2  # of the two frames before
    force_by_place = np.zeros((number, dim))
    formulas = _formulas(number) / interval
    counts = np.asarray(solved.balanced)
    for frame, (by_now, by_rate, by_place) in enumerate(zip(*parts, strict=True)):
        if not counts[frame]:
            slopes.append(slopes[-1])
            continue
        past = formulas[frame, 1] * slopes[-1] + formulas[frame, 2] * slopes[-2]
        matrix = by_now + formulas[frame, 0] * by_rate
        right = by_place + by_rate @ past
        slope = -np.linalg.solve(matrix[:-axes], right[:-axes])
        force_by_place[frame] = matrix[-axes] @ slope + right[-axes]
        slopes.append(slope)
    by = np.stack(slopes[2:]).reshape(number, -1, axes, dim)
    markers = np.einsum("mf,tfid->tmid", np.asarray(basis.at_markers, np.float64), by)
    markers = np.where(np.asarray(pull.seen)[..., None, None], markers, 0)
    measured = 0.0 if pull.force is None else np.asarray(pull.force, np.float64)
    return Reduced(
        np.asarray(solved.markers, np.float64)[counts].ravel(),
        markers[counts].reshape(-1, dim),
        (np.asarray(solved.force, np.float64) - measured)[counts],
        (force_by_place / float(end_value(basis.virtual)))[counts],
        counts,
    )


def _formulas(frames: int) -> Float[np.ndarray, "frame 3"]:
    return np.array([FORMULAS[min(frame, 2)] for frame in range(frames)])


def balance(
    space: ParameterSpace,
    networks: list[Network],
    pulls: list[Pull],
    place: Float[np.ndarray, " dim"],
    marker: float,
    force: float,
    strain: Strain = green,
    degrees: tuple[int, int] = DEGREES,
    steps: int = STEPS,
) -> Balanced:
    """The place in the parameter space whose motions in balance fit markers and force best.

    The ranges count as a flat prior. A force that was not measured does not count.

    - `networks`: trained, one for each of the `pulls`.
    - `place`: to begin with, in the space's unit cube.
    - `marker`, `force`: noise of the markers [m] and of the force over its greatest [-] to begin
      with. What is left of the residuals replaces them.
    - `strain`: `green` or `small`.
    - `degrees`: of the virtual displacements, along and across the pull.
    - `steps`: at most.

    Raises `RuntimeError` when no motion is in balance.
    """
    bases = [basis_of(pull, degrees) for pull in pulls]
    prepared_pulls = [prepared(*each) for each in zip(networks, pulls, bases, strict=True)]
    starts = [start for *_, start in prepared_pulls]
    place = np.clip(np.asarray(place, np.float64), INSIDE, 1 - INSIDE)
    places, losses, last, longest, converged = [], [], np.zeros_like(place), LONGEST, False
    normal, here = np.eye(len(place)), []
    for _ in range(steps):
        at, here = jnp.asarray(place, float), []
        for i, (pull, basis) in enumerate(zip(pulls, bases, strict=True)):
            even, off, _ = prepared_pulls[i]
            solved = solve(space, at, pull, basis, even, off, starts[i], strain)
            if not np.isfinite(np.asarray(solved.coefficients)).all():
                raise RuntimeError(f"pull {i} has no motion in balance: it is not finite")
            starts[i] = solved.coefficients
            here.append(reduced(solved, pull, basis))
        if not any(len(one.force) for one in here):
            raise RuntimeError("no pull has a motion in balance")
        information, right = _normal_equations(here, pulls, marker, force)
        normal = information + FLAT_PRIOR * np.eye(len(place))
        change = _step(normal, right + FLAT_PRIOR * (0.5 - place), place)
        whole = bool(np.all(np.abs(change) <= longest))
        if whole and change @ normal @ last < 0:  # friction is curved: Newton may go to and fro
            longest = max(np.abs(change).max() / 2, 1e-3)
        after = np.clip(place + np.clip(change, -longest, longest), INSIDE, 1 - INSIDE)
        last, place = after - place, after
        marker_left = _rms([one.markers for one in here])
        force_left = _rms([one.force / _greatest(p) for one, p in zip(here, pulls, strict=True)])
        losses.append(marker_left**2)
        places.append(place)
        are_balanced = all(one.is_complete for one in here)
        if whole and are_balanced:  # what is left of a longer step is not noise
            marker, force = max(marker_left, LEAST_NOISE[0]), max(force_left, LEAST_NOISE[1])
        standard_errors = np.sqrt(np.diag(np.linalg.inv(normal)))
        if whole and are_balanced and np.all(np.abs(last) < SMALL * standard_errors):
            converged = True
            break
    law = np.zeros_like(normal)
    if not stiffens(space.ranges):
        law = _law_error(here, pulls, marker, force)
    history = np.array(places), np.array(losses)
    return Balanced(place, np.linalg.inv(normal), marker, force, *history, converged, law)


def _law_error(
    here: list[Reduced], pulls: list[Pull], marker: float, force: float
) -> Float[np.ndarray, "dim dim"]:
    """Covariance of the place at small strain, for what stiffness changes with the stretch: by the
    frames up to half of the greatest, see `r2s.estimation.law_error`."""
    early = [one.where(_half_way(pull)) for one, pull in zip(here, pulls, strict=True)]
    if not any(len(one.force) for one in early):
        return np.zeros((here[0].force_by_place.shape[1],) * 2)
    sides = []
    for some in (early, here):
        information, right = _normal_equations(some, pulls, marker, force)
        inverse = np.linalg.inv(information + FLAT_PRIOR * np.eye(len(right)))
        sides.append((inverse @ right, np.diag(inverse)))
    (half, half_variance), (whole, variance) = sides
    off = to_small_strain(half - whole, half_variance - variance)
    return np.outer(off, off)


def _half_way(pull: Pull) -> Bool[np.ndarray, " frame"]:
    """The frames up to half of the greatest stretch."""
    apart = np.asarray(pull.far.value, np.float64) - np.asarray(pull.near.value, np.float64)
    stretch = np.linalg.norm(apart - apart[0], axis=-1)
    return stretch <= stretch.max() / 2


def _normal_equations(here: list[Reduced], pulls: list[Pull], marker: float, force: float):
    """Information of all pulls on the place, and minus the gradient of half the squares."""
    dim = here[0].markers_by_place.shape[1]
    information, right = np.zeros((dim, dim)), np.zeros(dim)
    for one, pull in zip(here, pulls, strict=True):
        rows = [(one.markers / marker, one.markers_by_place / marker)]
        if pull.force is not None:
            noise = force * _greatest(pull)
            rows.append((one.force / noise, one.force_by_place / noise))
        for value, slope in rows:
            information += slope.T @ slope
            right -= slope.T @ value
    return information, right


def _step(normal: np.ndarray, right: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The Gauss-Newton step, along the ends of the ranges where it would leave them."""
    change = np.linalg.solve(normal, right)
    out = (place <= INSIDE) & (change < 0) | (place >= 1 - INSIDE) & (change > 0)
    free = np.flatnonzero(~out)
    change = np.zeros_like(change)
    change[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free])
    return change


def _greatest(pull: Pull) -> float:
    """The greatest force of a pull [N]; 1 without one."""
    return 1.0 if pull.force is None else float(np.abs(np.asarray(pull.force)).max())


def _rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate([value.ravel() for value in values]) ** 2)))
