"""The physics-informed network from clouds without markers: a sheet that is lifted, or in the wind.

For each recording a network from (X, Y, t) to places is fitted, with one fabric for all, to the
clouds (each point to the nearest place of the network's own map, matched again and again), to the
grippers' path, and to the balance of forces in the weak form. Gravity gives the scale, since the
areal density is known. The fit begins with the motion of a middling fabric in the cloth solver.

It does not find the fabric. The maps come to lie near the points (a spread of 1 to 2 mm) and forces
balance to 1 %, but with a membrane far too soft, also when it begins with the true one, and from
two motions. Clouds do not say how the sheet lies within its surface, and the part on the table is
unseen. Why it fails was not measured; perhaps because a softer fabric makes less of the roughness
of the map. The information is there, also beside a map in which forces balance but nearly
(`experiments/unbalanced_maps.py`). For clouds there is `r2s.estimation.diffcloud`.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance, point_estimate
from r2s.estimation.pinn.hanging_sheet import (
    Hanging,
    Splines,
    loose,
    splines,
    virtual_work,
    work_scale,
)
from r2s.estimation.pinn.levenberg_marquardt import FIRST, Term, least_squares
from r2s.estimation.pinn.matching import (
    Rows,
    Sight,
    above,
    axes_of,
    bordered,
    fixed,
    matched,
    placed,
    sight_of,
)
from r2s.estimation.pinn.network import Network, X, Y, at_time
from r2s.estimation.pinn.stress import green
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import ParameterSpace
from r2s.geometry.mesh import Mesh, rectangle
from r2s.recordings.recording import Recording
from r2s.scenarios.scenario import GUST, JET, from_recording, rollout
from r2s.world.air import Air, Fan

GRIP = 3e-4  # standard error of the grippers' path, [m]
BEGIN = 5e-3  # that of the cloth solver's motion, which the network follows at first, [m]
LOW = 0.01  # height above the table below which the sheet may touch it, [m]
STRAIN = 0.02  # standard deviation of the strain on the table, where nothing else gives it, [-]
GUST_OVER = GUST + 1.0  # time after the first frame when the wind blows evenly, [s]
SHARPER = 0.7  # of the noise of the points: what a round leaves of it
SETTLED = 2e-3  # of the ranges: a round that moves the fabric less is the last
INSIDE = 1e-3  # least distance from the ends of the ranges
PRIOR = 12.0**0.5  # one over the standard deviation of a uniform distribution on 0..1
FIRM = 1e3  # the same of a fabric that is held
COARSE, FINE = (7, 7), (33, 33)  # vertices of what is tested on the table, and of the matching


@dataclass(frozen=True)
class Settings:
    """How to fit.

    - `frames`: number of frames, evenly among those that count.
    - `points`: number of points in each that are matched.
    - `balanced`: every so many-th of the frames is tested for balance.
    - `tolerance`: to which forces balance, over the stress from the sheet's own weight, [-].
    - `begin`: steps at first, to the motion of the cloth solver.
    - `rounds`: of matching, at most. `steps`: in each round.
    - `held`: first rounds, in which the fabric does not move, so that it does not go soft to suit a
      rough map.
    - `noise`: of the points [m]. The fit comes nearer to it from round to round.
    - `width`, `layers`: of the network.
    """

    frames: int = 12
    points: int = 200
    balanced: int = 2
    tolerance: float = 0.01
    begin: int = 20
    held: int = 3
    rounds: int = 30
    steps: int = 3
    noise: float = 1.5e-3
    width: int = 24
    layers: int = 4


# parameters of a network (of all of them, one after the other), then the place in the space
Theta = Float[Array, " theta"]


class Round(NamedTuple):
    """What a round of matching and steps led to.

    - `number`: from 0.
    - `spread`: of the distances of points from the maps (1.48 times the median) before the steps,
      root mean square of the recordings, [m].
    - `squares`: sum of all squares of residuals after them, [-].
    - `values`: of the parameters after them.
    """

    number: int
    spread: float
    squares: float
    values: Float[np.ndarray, " dim"]


Report = Callable[[Round], None]


class Shared(eqx.Module):
    """What all rows of residuals share.

    - `likeness`: a network; theta has parameters for it.
    - `space`: theta ends with a place in it.
    - `hanging`: what acts on the sheet.
    - `parts`: the virtual displacements.
    - `tolerance`: see `Settings`.
    """

    likeness: Network
    space: ParameterSpace
    hanging: Hanging
    parts: Splines
    tolerance: Float[Array, ""]

    def network(self, theta: Theta) -> Network:
        """The network of theta."""
        return with_parameters(self.likeness, theta)


def parameters_of(network: Network) -> Float[np.ndarray, " parameter"]:
    """The parameters of a network as one vector."""
    return np.asarray(ravel_pytree(network.params)[0], np.float64)


def with_parameters(likeness: Network, theta: Theta) -> Network:
    """A network like another one, whose parameters are the first numbers of a vector."""
    own, unravel = ravel_pytree(likeness.params)
    return eqx.tree_at(lambda n: n.params, likeness, unravel(theta[: len(own)]))


def prior(place: Float[np.ndarray, " dim"], weight: float = PRIOR) -> Term:
    """Rows that draw the end of theta to a `place` in the space, with a weight [-].

    To the middle of the space, with the default weight, it is the ranges as a flat prior.
    """
    rows = jnp.arange(-len(place), 0), jnp.asarray(place, float)
    return Term(_of_prior, jnp.asarray(weight, float), rows)


def _of_prior(theta: Theta, weight: Array, row) -> Array:
    which, at = row
    return weight * (theta[which] - at)[None]


def clipped(dim: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function that keeps the last `dim` numbers of theta within the ranges."""

    def inside(theta: np.ndarray) -> np.ndarray:
        return np.append(theta[:-dim], np.clip(theta[-dim:], INSIDE, 1 - INSIDE))

    return inside


class Motion(eqx.Module):
    """A recording and its network.

    - `shared`, `sight`: what its rows share, and what was seen.
    - `grips`: names of the corners that are held. `held`: rows of their path.
    - `own`: which numbers of theta are of its network; then those of the place in the space.
    - `fine`, `coarse`: meshes of the sheet, of the matching and of what is tested on the table.
    """

    shared: Shared
    sight: Sight
    grips: tuple[str, ...] = eqx.field(static=True)
    held: Rows
    own: Int[Array, " own"]
    fine: Mesh
    coarse: Mesh

    def of(self, theta: Float[np.ndarray, " theta"]) -> Network:
        """Its network."""
        return self.shared.network(jnp.asarray(theta, float)[self.own])

    def term(self, function: Callable[..., Array], rows, together: int = 256) -> Term:
        """Residuals of its network and the fabric."""
        return Term(function, self.shared, rows, together, self.own)


def estimate(
    recordings: Sequence[Recording],
    space: ParameterSpace,
    settings: Settings = Settings(),
    *,
    begin: Float[np.ndarray, " dim"] | None = None,
    report: Report | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of one or more recordings of a sheet that is lifted or hangs, from their clouds.

    It has no standard errors: what it finds is far from the truth, and no linear model says how
    far. One that still moved in its last round has not converged. A step solves for the parameters
    of all networks at once: its cost grows with the cube of the number of recordings.

    - `begin`: place in the space of the fabric to begin with, by default the middle.
    - `report`: called after each round.

    Raises `ValueError` for no recording or too few frames, `RuntimeError` when the solver or the
    network diverges.
    """
    if not recordings:
        raise ValueError("a recording is needed at least")
    if settings.rounds < 1:
        raise ValueError(f"at least one round is needed, got {settings.rounds}")
    began = time.perf_counter()
    place = np.full(space.dim, 0.5) if begin is None else np.asarray(begin, np.float64)
    fabric = space(jnp.asarray(place, float))
    motions: list[Motion] = []
    drawn = [prior(place)]
    for number, recording in enumerate(recordings):
        frames = np.array(frames_of(recording, settings.frames))
        sight = sight_of(recording, frames, settings.points)
        one = jax.random.fold_in(key, number)
        motion = _motion(recording, space, sight, settings, number, len(recordings), one)
        solver = _of_solver(recording, fabric, sight, frames)
        drawn += [motion.term(_of_row, motion.held), motion.term(_of_row, solver)]
        motions.append(motion)
    networks = [parameters_of(motion.shared.likeness) for motion in motions]
    theta = np.concatenate([*networks, place])
    theta = least_squares(drawn, theta, settings.begin, inside=clipped(space.dim)).parameters
    found = _rounds(motions, theta, settings, report)
    words = f"clouds of {', '.join(each.info.scenario for each in recordings)}"
    return _estimate(words, space, found, time.perf_counter() - began)


class Found(NamedTuple):
    """Where the rounds arrived.

    - `place`: in the parameter space.
    - `settled`: whether the fabric hardly moved in the last round.
    - `history`: every round.
    """

    place: np.ndarray
    settled: bool
    history: list[Round]


def _rounds(
    motions: Sequence[Motion], theta: np.ndarray, settings: Settings, report: Report | None
) -> Found:
    """Match points and make a few steps, again and again.

    The fabric follows when the maps are in balance.
    """
    space = motions[0].shared.space
    dim, history, settled = space.dim, [], False
    damping, noises = FIRST, [np.inf] * len(motions)
    firm, free = prior(theta[-dim:], FIRM), prior(np.full(dim, 0.5))
    for number in range(settings.rounds):
        terms, spreads = [firm if number < settings.held else free], []
        for i, motion in enumerate(motions):
            network = motion.of(theta)
            near, spread = matched(network, motion.sight, motion.fine)
            spreads.append(float(spread))
            # not the spread itself: what is far off would never be worth coming nearer
            noises[i] = max(settings.noise, min(spreads[i], SHARPER * noises[i]))
            near = near._replace(weight=near.weight * (spreads[i] / noises[i]))
            terms += [
                motion.term(_of_row, motion.held),
                motion.term(_of_row, near),
                motion.term(_of_row, bordered(network, motion.sight)),
                *_of_table(network, motion),
                _of_balance(network, motion, settings.balanced),
            ]
        found = least_squares(terms, theta, settings.steps, inside=clipped(dim), damping=damping)
        moved = np.abs(found.parameters - theta)[-dim:].max()
        theta, damping = found.parameters, min(found.damping, FIRST)
        values = np.asarray(space.values(jnp.asarray(theta[-dim:], float)))
        spread = float(np.mean(np.square(spreads)) ** 0.5)
        history.append(Round(number, spread, float(found.squares[-1]), values))
        if report is not None:
            report(history[-1])
        sharp = number > settings.held and max(noises) == settings.noise
        settled = sharp and bool(moved < SETTLED)
        if settled:
            break
    return Found(theta[-dim:], settled, history)


def frames_of(recording: Recording, number: int = Settings.frames) -> tuple[int, ...]:
    """Which frames are looked at: some, evenly spaced among those that count; in a wind, among
    those when it blows evenly. Raises `ValueError` for fewer than three."""
    first, last = recording.info.frames_used
    times = np.asarray(recording.times)
    if recording.info.wind is not None:
        first = max(first, int(np.searchsorted(times, times[0] + GUST_OVER)))
    if last - first < 2:
        raise ValueError(
            f"recording {recording.info.name}: frames {first} to {last} count, three are needed at "
            "least" + (f", {GUST_OVER:g} s after the wind rises" if recording.info.wind else "")
        )
    return tuple(np.unique(np.linspace(first, last, number).round().astype(int)).tolist())


def _motion(
    recording: Recording,
    space: ParameterSpace,
    sight: Sight,
    settings: Settings,
    number: int,
    count: int,
    key: PRNGKeyArray,
) -> Motion:
    """The `number`-th of `count` recordings, from 0; the networks of all are of one size."""
    shared = _shared(recording, space, sight, settings, key)
    size = len(parameters_of(shared.likeness))
    network, place = number * size + jnp.arange(size), count * size + jnp.arange(space.dim)
    sides = float(sight.size[0]), float(sight.size[1])
    return Motion(
        shared,
        sight,
        recording.info.sheet.held,
        fixed(sight.corners, sight.times, sight.grips, GRIP),
        jnp.concatenate([network, place]),
        rectangle(sides, FINE),
        rectangle(sides, COARSE),
    )


def _shared(
    recording: Recording,
    space: ParameterSpace,
    sight: Sight,
    settings: Settings,
    key: PRNGKeyArray,
) -> Shared:
    axes, wind, fan = axes_of(recording), np.zeros(3), None
    if recording.info.wind is not None and any(recording.info.wind):
        wind = axes @ np.asarray(recording.info.wind)
        middle, side = np.append(np.asarray(sight.size) / 2, 0), float(jnp.min(sight.size))
        parts = middle, wind, JET[0] * side, JET[1] * side
        fan = Fan(*(jnp.asarray(part, float) for part in parts))
    likeness = Network.make(
        jnp.zeros(3, float),
        jnp.append(sight.size, sight.times[-1]),
        jnp.max(sight.size) / 4,
        axes=3,
        width=settings.width,
        layers=settings.layers,
        key=key,
    )
    hanging = Hanging(sight.size, -sight.up, Air.make(), fan, jnp.asarray(wind, float))
    tolerance = jnp.asarray(settings.tolerance, float)
    return Shared(likeness, space, hanging, splines(), tolerance)


def _of_solver(recording: Recording, fabric: Fabric, sight: Sight, frames: np.ndarray) -> Rows:
    """Rows that draw the map to the motion of a fabric in the cloth solver."""
    scenario = from_recording(recording)
    moved = eqx.filter_jit(rollout)(scenario, fabric)
    x = np.asarray(moved.x, np.float64)[frames]
    if not np.isfinite(x).all():
        raise RuntimeError(f"recording {recording.info.name}: the cloth {moved.explain()}")
    local = (x - np.asarray(recording.info.sheet.origin)) @ axes_of(recording).T
    return fixed(scenario.scene.mesh.rest, sight.times, jnp.asarray(local, float), BEGIN)


def _of_row(theta: Theta, shared: Shared, row: Rows) -> Array:
    at = placed(shared.network(theta), row.place[None])[0]
    return (row.weight * (row.direction @ (at - row.target)))[None]


def _of_table(network: Network, motion: Motion) -> list[Term]:
    """Terms that keep the map above the table, and unstretched where it lies on it."""
    sight = motion.sight
    lifted = above(network, sight, motion.coarse)
    height = placed(network, lifted.place) @ sight.up - sight.table
    weight = jnp.where(height < LOW, 1 / STRAIN, 0.0)
    return [motion.term(_of_row, lifted), motion.term(_of_strain, (lifted.place, weight))]


def _of_strain(theta: Theta, shared: Shared, row) -> Array:
    place, weight = row
    jet = shared.network(theta).jet(place[None], ())
    return weight * green(jnp.stack([jet.first[X, 0], jet.first[Y, 0]], axis=1))


def _of_balance(network: Network, motion: Motion, every: int) -> Term:
    """The work of all forces in every so many-th frame, where the sheet is neither held nor on the
    table."""
    names = ("origin", "warp", "weft", "opposite")  # in the order of `loose`
    shared, sight = motion.shared, motion.sight
    held = jnp.array([name in motion.grips for name in names])
    places = shared.parts.nodes * sight.size[None]

    def free(time: Float[Array, ""]) -> Bool[Array, " function"]:
        low = placed(network, at_time(places, time)) @ sight.up - sight.table < LOW
        return loose(shared.parts, held, low)

    times = sight.times[every // 2 :: every]
    return motion.term(_of_work, (times, jax.vmap(free)(times)), 1)


def _of_work(theta: Theta, shared: Shared, row) -> Array:
    time, free = row
    fabric = shared.space(theta[-shared.space.dim :])
    work = virtual_work(shared.network(theta), shared.hanging, fabric, shared.parts, time)
    scale = shared.tolerance * work_scale(shared.hanging, fabric.density, shared.parts)
    return jnp.where(free[:, None], work / scale[:, None], 0).ravel()


def _estimate(words: str, space: ParameterSpace, found: Found, seconds: float) -> Estimate:
    """The estimate of the last round."""
    squares = np.array([each.spread**2 for each in found.history])[:, None]
    estimate = point_estimate(
        f"pinn (weak form, {words})",
        space,
        jnp.asarray(found.place, float),
        float(squares[-1, 0]),
        squares,
        np.stack([each.values for each in found.history])[:, None],
        seconds,
        converged=found.settled,
    )
    spread = Nuisance("spread of distances", "m", float(squares[-1, 0] ** 0.5), np.nan)
    return dataclasses.replace(estimate, nuisances=(spread,))
