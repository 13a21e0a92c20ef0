"""The physics-informed network from clouds without markers: a sheet that is lifted, or in the wind.

A network from (X, Y, t) to places is fitted, with the fabric, to the clouds (each point to the
nearest place of the network's own map, matched again and again), to the grippers' path, and to the
balance of forces in the weak form, where gravity, the areal density being known, gives the scale.
It begins as a middling fabric moves in the cloth solver. Gauss and Newton's steps give the
information on the fabric with the whole map unknown beside it: what the clouds do not determine
keeps the deviation of its range.

It does not find the fabric: the map comes to lie within 2 mm of the points and forces balance to
1 %, but with a stiffness far too low, also when it begins with the true one. Clouds say nothing of
how the sheet lies within its surface, what rests on the table is unseen, and a softer fabric makes
less of the roughness of the map. For clouds there is `r2s.estimation.diffcloud`.
"""

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.pinn.exact import PRIOR, clipped, ranged, weights_of, with_weights
from r2s.estimation.pinn.hanging_sheet import (
    Hanging,
    Splines,
    loose,
    splines,
    virtual_work,
    work_scale,
)
from r2s.estimation.pinn.levenberg_marquardt import FIRST, Term, Unknown, least_squares, marginal
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

GRIP = 3e-4  # [m], to which the gripper's path is known
BEGIN = 5e-3  # [m], to which the network first follows the cloth solver
LOW = 0.01  # [m] above the table, below which it may touch
STRAIN = 0.02  # on the table, where nothing else says how the sheet is stretched
GUST_OVER = GUST + 1.0  # [s] after the first frame, when the wind blows evenly
ALIKE = 8  # frames of a lift over which what is not modelled errs alike; of a wind all
SHARPER = 0.7  # what a round leaves of the deviation that distances are divided by
SETTLED = 2e-3  # of the ranges: a round that moves the fabric less is the last
FIRM = 1e3  # one over the deviation of a fabric that is held
COARSE, FINE = (7, 7), (33, 33)  # vertices: of what is tested on the table, and of the matching


@dataclass(frozen=True)
class Settings:
    """How to fit.

    - `frames`: of those that count, evenly. - `points`: of each, matched. - `balanced`: of these
      frames every so many-th is tested for balance.
    - `tolerance`: to which forces balance, of the stress from the sheet's own weight, [-].
    - `begin`, `rounds`, `steps`: at first; of matching, at most; and in each round.
    - `held`: rounds in which the fabric stays what it begins with, so that it does not go soft to
      suit a rough map.
    - `noise`: of the points, to which the fit comes nearer from round to round, [m].
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


class About(eqx.Module):
    """What rows of residuals share; see `r2s.estimation.pinn.exact.About`."""

    likeness: Network
    space: ParameterSpace
    hanging: Hanging
    parts: Splines
    tolerance: Float[Array, ""]


def estimate(
    recording: Recording,
    space: ParameterSpace,
    settings: Settings = Settings(),
    *,
    begin: Float[np.ndarray, " dim"] | None = None,
    report: Any = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric of a recording of a sheet that is lifted or hangs, from its clouds.

    `begin` is the place in the space of the fabric to begin with, by default the middle. `report`
    is called after each round with its number, the spread of the distances [m] and the
    parameters. An estimate that still moved in its last round says "not converged", and has no
    deviations. Raises `ValueError` for too few frames, `RuntimeError` when the solver or the
    network diverges.
    """
    if settings.rounds < 1:
        raise ValueError(f"at least one round is needed, got {settings.rounds}")
    began = time.perf_counter()
    frames = _frames(recording, settings.frames)
    sight = sight_of(recording, frames, settings.points)
    about = _about(recording, space, sight, settings, key)
    held = fixed(sight.corners, sight.times, sight.grips, GRIP)
    place = np.full(space.dim, 0.5) if begin is None else np.asarray(begin, np.float64)
    solver = _of_solver(recording, space(jnp.asarray(place, float)), sight, frames)
    unknown = np.concatenate([weights_of(about.likeness), place])
    terms = [_rows(about, held), _rows(about, solver), ranged(place)]
    unknown = least_squares(terms, unknown, settings.begin, inside=clipped(space.dim)).unknown
    found = _rounds(about, sight, held, unknown, recording.info.sheet.held, settings, report)
    still = recording.info.wind is not None
    few = len(frames) if still else max(1.0, ALIKE * len(frames) / _counted(recording))
    words = f"clouds of {recording.info.scenario}" + ("" if found.settled else ", not converged")
    return _estimate(words, space, found, few, time.perf_counter() - began)


class Found(NamedTuple):
    """Where the rounds arrived.

    - `unknown`, `information`: on it. - `settled`: the fabric hardly moved in the last round.
    - `history`: square of the spread of the distances [m^2] and the parameters, of every round.
    """

    unknown: np.ndarray
    information: np.ndarray
    settled: bool
    history: list[tuple[float, np.ndarray]]


def _rounds(about: About, sight: Sight, held: Rows, unknown, names, settings, report) -> Found:
    """Match, and make a few steps; the fabric follows when the map is in balance."""
    size, dim = (float(sight.size[0]), float(sight.size[1])), about.space.dim
    fine, coarse = rectangle(size, FINE), rectangle(size, COARSE)
    damping, history, settled, information = FIRST, [], False, np.zeros((dim, dim))
    deviation = np.inf
    firm, free = ranged(unknown[-dim:], FIRM), ranged(np.full(dim, 0.5))
    for number in range(settings.rounds):
        network = with_weights(about.likeness, jnp.asarray(unknown, float))
        near, spread = matched(network, sight, fine)
        # not the spread itself: what is far off would never be worth coming nearer
        deviation = max(settings.noise, min(float(spread), SHARPER * deviation))
        near = near._replace(weight=near.weight * (float(spread) / deviation))
        terms = [_rows(about, held), _rows(about, near), _rows(about, bordered(network, sight))]
        terms += _of_table(network, about, sight, coarse)
        terms.append(firm if number < settings.held else free)
        terms.append(_of_balance(network, about, sight, names, settings.balanced))
        found = least_squares(terms, unknown, settings.steps, inside=clipped(dim), damping=damping)
        moved = np.abs(found.unknown - unknown)[-dim:].max()
        unknown, damping = found.unknown, min(found.damping, FIRST)
        information = found.information
        values = np.asarray(about.space.values(jnp.asarray(unknown[-dim:], float)))
        history.append((float(spread) ** 2, values))
        if report is not None:
            report(number, float(spread), values)
        sharp = number > settings.held and deviation == settings.noise
        settled = sharp and bool(moved < SETTLED)
        if settled:
            break
    return Found(unknown, marginal(information, dim), settled, history)


def _counted(recording: Recording) -> int:
    first, last = recording.info.frames_used
    return last - first + 1


def _frames(recording: Recording, number: int) -> np.ndarray:
    """Evenly of those that count; in a wind of those when it blows evenly."""
    first, last = recording.info.frames_used
    times = np.asarray(recording.times)
    if recording.info.wind is not None:
        first = max(first, int(np.searchsorted(times, times[0] + GUST_OVER)))
    if last - first < 2:
        raise ValueError(
            f"recording {recording.info.name}: frames {first} to {last} count, three are needed at "
            "least" + (f", {GUST_OVER:g} s after the wind rises" if recording.info.wind else "")
        )
    return np.unique(np.linspace(first, last, number).round().astype(int))


def _about(recording, space, sight: Sight, settings: Settings, key) -> About:
    array = lambda value: jnp.asarray(value, float)
    axes, wind = axes_of(recording), np.zeros(3)
    fan = None
    if recording.info.wind is not None and any(recording.info.wind):
        wind = axes @ np.asarray(recording.info.wind)
        middle, side = np.append(np.asarray(sight.size) / 2, 0), float(jnp.min(sight.size))
        fan = Fan(array(middle), array(wind), array(JET[0] * side), array(JET[1] * side))
    low = jnp.zeros(3, float)
    high = jnp.append(sight.size, sight.times[-1])
    scale = jnp.max(sight.size) / 4
    make = {"axes": 3, "width": settings.width, "layers": settings.layers}
    likeness = Network.make(low, high, scale, **make, key=key)
    hanging = Hanging(sight.size, -sight.up, Air.make(), fan, array(wind))
    return About(likeness, space, hanging, splines(), array(settings.tolerance))


def _of_solver(recording: Recording, fabric: Fabric, sight: Sight, frames: np.ndarray) -> Rows:
    """Rows that draw the map to how a fabric moves in the cloth solver."""
    scenario = from_recording(recording)
    moved = eqx.filter_jit(rollout)(scenario, fabric)
    x = np.asarray(moved.x, np.float64)[frames]
    if not np.isfinite(x).all():
        raise RuntimeError(f"recording {recording.info.name}: the cloth solver diverged")
    local = (x - np.asarray(recording.info.sheet.origin)) @ axes_of(recording).T
    return fixed(scenario.scene.mesh.rest, sight.times, jnp.asarray(local, float), BEGIN)


def _rows(about: About, rows: Rows) -> Term:
    return Term(_of_row, about, rows)


def _of_row(unknown: Unknown, about: About, row: Rows) -> Array:
    at = placed(with_weights(about.likeness, unknown), row.place[None])[0]
    return (row.weight * (row.direction @ (at - row.target)))[None]


def _of_table(network: Network, about: About, sight: Sight, mesh: Mesh) -> list[Term]:
    """What keeps the map above the table, and unstretched where it lies on it."""
    lifted = above(network, sight, mesh)
    height = placed(network, lifted.place) @ sight.up - sight.table
    weight = jnp.where(height < LOW, 1 / STRAIN, 0.0)
    return [_rows(about, lifted), Term(_of_strain, about, (lifted.place, weight))]


def _of_strain(unknown: Unknown, about: About, row) -> Array:
    place, weight = row
    jet = with_weights(about.likeness, unknown).jet(place[None], ())
    return weight * green(jnp.stack([jet.first[X, 0], jet.first[Y, 0]], axis=1))


def _of_balance(network: Network, about: About, sight: Sight, grips, every: int) -> Term:
    """Forces in every so many-th frame, where the sheet is neither held nor on the table."""
    names = ("origin", "warp", "weft", "opposite")  # in the order of `loose`
    held = jnp.array([name in grips for name in names])
    places = about.parts.nodes * sight.size[None]

    def free(time):
        low = placed(network, at_time(places, time)) @ sight.up - sight.table < LOW
        return loose(about.parts, held, low)

    times = sight.times[every // 2 :: every]
    return Term(_of_work, about, (times, jax.vmap(free)(times)), 1)


def _of_work(unknown: Unknown, about: About, row) -> Array:
    time, free = row
    fabric = about.space(unknown[-about.space.dim :])
    network = with_weights(about.likeness, unknown)
    work = virtual_work(network, about.hanging, fabric, about.parts, time)
    scale = about.tolerance * work_scale(about.hanging, fabric.density, about.parts)
    return jnp.where(free[:, None], work / scale[:, None], 0).ravel()


def _estimate(
    words: str, space: ParameterSpace, found: Found, few: float, seconds: float
) -> Estimate:
    """What errs alike in `few` frames counts once. Without deviations while the fabric moves: what
    a linear model says of a place far from the best one is wrong."""
    own = found.information - PRIOR**2 * np.eye(space.dim)
    covariance = np.linalg.inv(own / few + PRIOR**2 * np.eye(space.dim))
    lengths = np.array([np.log(r.high / r.low) if r.log else r.high - r.low for r in space.ranges])
    deviations = np.sqrt(np.diag(covariance)) * (1.0 if found.settled else np.nan)
    place = jnp.asarray(found.unknown[-space.dim :], float)
    squares = np.array([square for square, _ in found.history])[:, None]
    return Estimate(
        approach=f"pinn (weak form, {words})",
        fabric=space(place),
        ranges=space.ranges,
        values=np.asarray(space.values(place)),
        standard_errors=lengths * deviations,
        correlation=covariance / np.outer(deviations, deviations),
        nuisances=(Nuisance("spread of distances", "m", float(squares[-1, 0] ** 0.5), np.nan),),
        loss=float(squares[-1, 0]),
        losses=squares,
        history=np.stack([values for _, values in found.history])[:, None],
        seconds=seconds,
    )
