"""Clouds without correspondences: which place of the network's map each of their points is of.

As in iterative closest point, places are found on the map as it stands. A residual is the distance
of the map from a point in one direction: along the normal for points within the sheet, outward for
the border of the cloud. Across it the map is free to slide until the next matching.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.estimation.pinn.network import Network, at_time
from r2s.evaluation.losses import surface_residuals
from r2s.geometry.mesh import Mesh
from r2s.recordings.recording import CORNERS, Recording, subsample

BINS = 6  # strips along each side of the border
DEPTH, OFF, BEYOND = 0.02, 0.006, 0.01  # of a strip into the sheet, off it and outward, [m]
OUTERMOST, FEWEST = 3, 6  # which point of a strip tells where it ends, and least number of points
LEAST = 3e-4  # spread of the distances, which no camera undercuts, [m]
CUT = 3.0  # of the spread: a point that is much farther off is an outlier


class Sight(eqx.Module):
    """What was seen of a sheet, in its axes at rest (warp, weft, normal).

    - `size`: of the sheet, [m].
    - `times`: of the frames, from the first one, [s].
    - `points`, `mask`: some of the points in each frame, which are matched, [m].
    - `cloud`, `there`: all of them.
    - `corners`: places on the sheet that the grippers hold, [m].
    - `grips`: where the grippers are, [m].
    - `up`: direction against gravity, [-].
    - `table`: its height above the sheet's corner at rest, along `up`, [m].
    """

    size: Float[Array, " 2"]
    times: Float[Array, " frame"]
    points: Float[Array, "frame point 3"]
    mask: Bool[Array, "frame point"]
    cloud: Float[Array, "frame all 3"]
    there: Bool[Array, "frame all"]
    corners: Float[Array, "grip 2"]
    grips: Float[Array, "frame grip 3"]
    up: Float[Array, " 3"]
    table: Float[Array, ""]


class Rows(NamedTuple):
    """Residuals: distances of the map from targets, along directions.

    - `place`: on the map (X [m], Y [m], t [s]).
    - `target`: [m]. `direction`: [-].
    - `weight`: one over the standard deviation, [1/m]; 0: the row does not count.
    """

    place: Float[Array, "row 3"]
    target: Float[Array, "row 3"]
    direction: Float[Array, "row 3"]
    weight: Float[Array, " row"]


def axes_of(recording: Recording) -> Float[np.ndarray, "3 3"]:
    """Directions of warp, weft and normal of the sheet at rest, in the world."""
    sheet = recording.info.sheet
    return np.array([sheet.warp, sheet.weft, np.cross(sheet.warp, sheet.weft)])


def sight_of(recording: Recording, frames: np.ndarray, num_points: int, seed: int = 0) -> Sight:
    """What was seen in some `frames`, with at most `num_points` of each to be matched.

    Raises `ValueError` when a frame that is asked for does not exist.
    """
    sheet, axes = recording.info.sheet, axes_of(recording)
    times = np.asarray(recording.times, np.float64)
    if len(frames) < 3 or frames.min() < 0 or frames.max() >= len(times):
        raise ValueError(
            f"recording {recording.info.name}: three frames or more of 0..{len(times) - 1} are "
            f"needed, got {frames.tolist()}"
        )

    def local(world) -> np.ndarray:
        return (np.asarray(world, np.float64) - np.asarray(sheet.origin)) @ axes.T

    few = subsample(recording, num_points, 0.005, seed)
    path, knots = local(recording.handle_path), np.asarray(recording.handle_times, np.float64)
    by_grip = np.moveaxis(path, 0, -1)  # (grip, axis, knot)
    grips = np.stack([[np.interp(times[frames], knots, axis) for axis in grip] for grip in by_grip])
    corners = np.array([CORNERS[name] for name in sheet.held]) * np.asarray(sheet.size)
    return Sight(
        size=jnp.asarray(sheet.size, float),
        times=jnp.asarray(times[frames] - times[frames[0]], float),
        points=jnp.asarray(local(few.points)[frames], float),
        mask=few.mask[frames],
        cloud=jnp.asarray(local(recording.points)[frames], float),
        there=recording.mask[frames],
        corners=jnp.asarray(corners, float),
        grips=jnp.asarray(grips.transpose(2, 0, 1), float),
        up=jnp.asarray(axes @ np.array([0.0, 0.0, 1.0]), float),
        table=jnp.asarray(recording.info.table_height - sheet.origin[2], float),
    )


def placed(network: Network, points: Float[Array, "point 3"]) -> Float[Array, "point 3"]:
    """Positions [m] to which the map takes places and times (X, Y, t)."""
    return jnp.pad(points[:, :2], ((0, 0), (0, 1))) + network(points)


@eqx.filter_jit
def matched(network: Network, sight: Sight, mesh: Mesh) -> tuple[Rows, Float[Array, ""]]:
    """Rows that draw the map along its normal to the points, and the spread of the distances [m].

    Each point is matched to the nearest place of the map. Outliers hardly count (Geman and McClure
    1987).
    """

    def frame(given):
        points, mask, time = given
        x = placed(network, at_time(mesh.rest, time))
        gap, _, vertices, shares = surface_residuals(points, mask, x, mesh.faces)
        corners = x[vertices]
        across = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = across / jnp.sqrt(jnp.sum(across**2, axis=1, keepdims=True))
        place = jnp.einsum("pk,pki->pi", shares, mesh.rest[vertices])
        return at_time(place, time), normal, gap

    place, normal, gap = jax.lax.map(frame, (sight.points, sight.mask, sight.times))
    middle = jnp.nanmedian(jnp.where(sight.mask, gap, jnp.nan))
    spread = jnp.maximum(1.4826 * middle, LEAST)
    share = 1 / (1 + (gap / (CUT * spread)) ** 2)  # the square root of that of the squares
    weight = jnp.where(sight.mask, share, 0) / spread
    place, target, normal = (part.reshape(-1, 3) for part in (place, sight.points, normal))
    return Rows(place, target, normal, weight.ravel()), spread


@eqx.filter_jit
def bordered(network: Network, sight: Sight) -> Rows:
    """Rows that draw the map's border to that of the cloud, in the plane of the sheet.

    In a strip at the border with n points in a depth D, the k-th outermost point lies k D / n
    within the border. A border that is hidden or far off does not count: its strip has too few
    points.
    """
    along = (jnp.arange(BINS, dtype=sight.size.dtype) + 0.5) / BINS
    zero, one = jnp.zeros(BINS, along.dtype), jnp.ones(BINS, along.dtype)
    sides = [(along, zero, (0, -1)), (along, one, (0, 1)), (zero, along, (-1, 0))]
    sides.append((one, along, (1, 0)))
    places = jnp.concatenate([jnp.stack([x, y], 1) for x, y, _ in sides]) * sight.size[None]
    outward = jnp.repeat(jnp.array([normal for *_, normal in sides], along.dtype), BINS, axis=0)
    half = jnp.where(jnp.abs(outward[:, 0]) > 0, sight.size[1], sight.size[0]) / (2 * BINS)

    def strip(place, out, half, time, cloud, there):
        def position(place):
            return placed(network, jnp.append(place, time)[None])[0]

        at, slope = position(place), jax.jacfwd(position)(place)
        side = _unit(slope @ jnp.stack([-out[1], out[0]]))
        off = _unit(jnp.cross(slope[:, 0], slope[:, 1]))
        away = jnp.cross(side, off)
        away = away * jnp.sign(away @ (slope @ out))
        offset = cloud - at[None]
        depth = offset @ away
        within = there & (jnp.abs(offset @ side) < half) & (jnp.abs(offset @ off) < OFF)
        within = within & (depth > -DEPTH) & (depth < BEYOND)
        number = jnp.sum(within, dtype=depth.dtype)
        outer = jnp.sort(jnp.where(within, depth, -jnp.inf))[-OUTERMOST]
        spacing = (DEPTH + jnp.clip(outer, -DEPTH / 2, BEYOND)) / jnp.maximum(number, 1)
        end = outer + OUTERMOST * spacing
        known = (number >= FEWEST) & jnp.isfinite(end)
        deviation = OUTERMOST**0.5 * spacing
        share = 1 / (1 + (end / (CUT * deviation)) ** 2)
        end = jnp.where(known, end, 0)
        return at + end * away, away, jnp.where(known, share / deviation, 0)

    def frame(given):
        time, cloud, there = given
        found = jax.vmap(strip, in_axes=(0, 0, 0, None, None, None))
        return at_time(places, time), *found(places, outward, half, time, cloud, there)

    rows = jax.lax.map(frame, (sight.times, sight.cloud, sight.there))
    place, target, away, weight = (part.reshape(-1, *part.shape[2:]) for part in rows)
    return Rows(place, target, away, weight)


def _unit(vector: Float[Array, " 3"]) -> Float[Array, " 3"]:
    return vector / jnp.sqrt(vector @ vector)


def fixed(
    places: Float[Array, "place 2"],
    times: Float[Array, " frame"],
    targets: Float[Array, "frame place 3"],
    deviation: float,
) -> Rows:
    """Rows that draw places of the sheet to known positions `targets` [m], in all directions."""
    frames, number, _ = targets.shape
    at = jnp.concatenate([at_time(places, time) for time in times])
    directions = jnp.tile(jnp.eye(3, dtype=targets.dtype), (frames * number, 1))
    weight = jnp.full(3 * frames * number, 1 / deviation, targets.dtype)
    at, targets = (jnp.repeat(part.reshape(-1, 3), 3, axis=0) for part in (at, targets))
    return Rows(at, targets, directions, weight)


@eqx.filter_jit
def above(network: Network, sight: Sight, mesh: Mesh, deviation: float = 1e-3) -> Rows:
    """Rows that lift the map onto the table where it is below, at the vertices of a mesh."""
    at = jax.vmap(lambda time: at_time(mesh.rest, time))(sight.times).reshape(-1, 3)
    x = placed(network, at)
    short = sight.table - x @ sight.up
    direction = jnp.broadcast_to(sight.up[None], x.shape)
    weight = jnp.where(short > 0, 1 / deviation, 0.0).astype(x.dtype)
    return Rows(at, x + short[:, None] * sight.up[None], direction, weight)
