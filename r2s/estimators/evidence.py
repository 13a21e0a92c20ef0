"""What a prediction says against what was seen: clouds, markers and forces, each a robust mean."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimators.prediction import Seen, Slope
from r2s.estimators.problem import FORCE_SCALE, Clouds, Force, Markers, Problem
from r2s.losses import length, masked_mean, robust, robust_weight, surface_residuals
from r2s.mesh import Mesh

Scale = Float[Array, ""] | float
Loss = Callable[[Problem, Seen], Float[Array, ""]]  # [m^2]

PATCHES = 3  # along a side of the sheet: what lies in one patch errs alike
MEMORY = 8  # frames, over which it does so


class Normals(eqx.Module):
    """A loss [m^2] with its gradient and Gauss-Newton matrix in the unknown [m^2], the scatter of
    the gradient between patches and frames [m^4], and the spread of the distances [m]."""

    loss: Float[Array, ""]
    gradient: Float[Array, " unknown"]
    matrix: Float[Array, "unknown unknown"]
    scatter: Float[Array, "unknown unknown"]
    spread: Float[Array, ""]

    @classmethod
    def zero(cls, count: int, dtype) -> "Normals":
        """Of no evidence."""
        nothing, square = jnp.zeros((), dtype), jnp.zeros((count, count), dtype)
        return cls(nothing, jnp.zeros(count, dtype), square, square, nothing)


def loss_of(problem: Problem, seen: Seen, scale: Scale = 0.0) -> Float[Array, ""]:
    """The robust mean [m^2] of all that was seen; `scale` [m] as of `r2s.losses.robust`."""
    mesh, total = problem.scenario.scene.mesh, jnp.zeros((), seen.x.dtype)
    if problem.clouds is not None:
        total += masked_mean(
            robust(_residuals(problem.clouds, mesh, seen)[0], scale), problem.clouds.mask
        )
    if problem.markers is not None:
        gap = _gaps(problem.markers, seen.x)
        total += masked_mean(robust(length(gap), scale), problem.markers.seen)
    if problem.force is not None and seen.force is not None:
        total += jnp.mean(jnp.sum(_force_gaps(problem.force, seen.force) ** 2, axis=1)) / 2
    return total


def normals_of(problem: Problem, seen: Seen, slope: Slope, scale: Scale = 0.0) -> Normals:
    """Loss and normal equations of all that was seen, from a prediction and its derivative."""
    mesh = problem.scenario.scene.mesh
    parts = []
    if problem.clouds is not None:
        parts.append(_of_clouds(problem.clouds, mesh, seen, slope, scale))
    if problem.markers is not None:
        parts.append(_of_markers(problem.markers, mesh, seen, slope, scale))
    if problem.force is not None and seen.force is not None and slope.force is not None:
        parts.append(_of_force(problem.force, seen.force, slope.force))
    total = jax.tree.map(lambda *leaves: sum(leaves), *parts)
    return eqx.tree_at(lambda n: n.spread, total, parts[0].spread)


def _of_clouds(clouds: Clouds, mesh: Mesh, seen: Seen, slope: Slope, scale) -> Normals:
    distance, direction, vertices, weights = _residuals(clouds, mesh, seen)

    def frame(args):  # one at a time: its derivatives fit the cache
        slope, vertices, weights, direction = args
        moved = jnp.einsum("pk,pkiu->piu", weights, slope[vertices])
        return -jnp.einsum("pi,piu->pu", direction, moved)

    jacobian = jax.lax.map(frame, (slope.x, vertices, weights, direction))
    weight = jnp.where(clouds.mask, robust_weight(distance, scale), 0) / jnp.sum(
        clouds.mask, dtype=float
    )
    score = (weight * distance)[..., None] * jacobian
    return Normals(
        loss=masked_mean(robust(distance, scale), clouds.mask),
        gradient=jnp.sum(score, axis=(0, 1)),
        matrix=jnp.einsum("fp,fpu,fpv->uv", weight, jacobian, jacobian),
        scatter=_scatter(mesh, score, jnp.einsum("fpk,fpki->fpi", weights, mesh.rest[vertices])),
        spread=_spread(distance, clouds.mask),
    )


def _of_markers(markers: Markers, mesh: Mesh, seen: Seen, slope: Slope, scale) -> Normals:
    gap = _gaps(markers, seen.x)
    distance = length(gap)
    picked = slope.x[:, markers.vertices]  # (frame, marker, corner, axis, unknown)
    jacobian = jnp.einsum("mk,fmkiu->fmiu", markers.weights, picked)
    count = jnp.sum(markers.seen, dtype=float)
    weight = jnp.where(markers.seen, robust_weight(distance, scale), 0) / count
    score = jnp.einsum("fm,fmi,fmiu->fmu", weight, gap, jacobian)
    place = jnp.einsum("mk,mki->mi", markers.weights, mesh.rest[markers.vertices])
    return Normals(
        loss=masked_mean(robust(distance, scale), markers.seen),
        gradient=jnp.sum(score, axis=(0, 1)),
        matrix=jnp.einsum("fm,fmiu,fmiv->uv", weight, jacobian, jacobian),
        scatter=_scatter(mesh, score, jnp.broadcast_to(place[None], (*distance.shape, 2))),
        spread=_spread(distance, markers.seen),
    )


def _of_force(force: Force, pulled: Array, slope: Array) -> Normals:
    gap, jacobian = _force_gaps(force, pulled), FORCE_SCALE * slope
    count = len(gap)
    score = jnp.einsum("fd,fdu->fu", gap, jacobian) / count
    return Normals(
        loss=jnp.mean(jnp.sum(gap**2, axis=1)) / 2,
        gradient=jnp.sum(score, axis=0),
        matrix=jnp.einsum("fdu,fdv->uv", jacobian, jacobian) / count,
        scatter=_over_time(score[:, None]),
        spread=jnp.sqrt(jnp.mean(gap**2)),
    )


def _residuals(clouds: Clouds, mesh: Mesh, seen: Seen):
    """Of every frame, `surface_residuals`; one frame at a time, which fits the cache."""
    frame = lambda seen: surface_residuals(seen[0], seen[1], seen[2], mesh.faces)
    return jax.lax.map(frame, (clouds.points, clouds.mask, seen.x))


def _gaps(markers: Markers, x: Float[Array, "frame vertex 3"]) -> Float[Array, "frame marker 3"]:
    """From where markers were seen to where they should be [m]; zero where they were not seen."""
    expected = jnp.einsum("mk,fmki->fmi", markers.weights, x[:, markers.vertices])
    return jnp.where(markers.seen[..., None], expected - markers.positions, 0)


def _force_gaps(force: Force, pulled: Array) -> Float[Array, "frame direction"]:
    return FORCE_SCALE * (pulled - force.values)


def _spread(distance: Float[Array, "*shape"], mask) -> Float[Array, ""]:
    """The deviation [m] of a normal one with the same median."""
    return 1.4826 * jnp.nanmedian(jnp.where(mask, distance, jnp.nan))


def _scatter(
    mesh: Mesh,
    score: Float[Array, "frame point unknown"],
    place: Float[Array, "frame point 2"],
) -> Float[Array, "unknown unknown"]:
    """The covariance of the gradient, from the scores of the patches of the sheet.

    Points of a patch err alike, in one frame and in those near to it: sums over patches, weighted
    over the frames between them (Newey and West 1987).
    """
    extent = jnp.max(mesh.rest, axis=0) * (1 + 1e-3)
    cell = jnp.floor(place / extent[None, None] * PATCHES).astype(int)
    patch = jnp.clip(cell[..., 0] * PATCHES + cell[..., 1], 0, PATCHES**2 - 1)
    total = jax.vmap(lambda s, c: jax.ops.segment_sum(s, c, PATCHES**2))(score, patch)
    return _over_time(total)


def _over_time(score: Float[Array, "frame cluster unknown"]) -> Float[Array, "unknown unknown"]:
    frames = jnp.arange(len(score), dtype=float)
    near = jnp.maximum(0, 1 - jnp.abs(frames[:, None] - frames[None]) / MEMORY)
    return jnp.einsum("fcu,fg,gcv->uv", score, near, score)
