"""How far points are from a simulated sheet: zero for the sheet that they were taken from."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s.mesh.surface import nearest
from r2s.metrics.losses import length

POINTS = 1000  # of a frame, at most: their mean is within 3 % of that of all


def to_surface(
    clouds: list[np.ndarray], x: Float[np.ndarray, "frame vertex 3"], faces: Int[Array, "face 3"]
) -> Float[np.ndarray, " frame"]:
    """Mean distance [m] from each frame's points to the nearest place on the sheet.

    It is to the surface itself, where `r2s.metrics.distances` measures to samples of it. Of more
    than `POINTS` points so many are drawn, always the same: the order of a recording's points may
    be that of their places. NaN where `x` is not finite.
    Raises `ValueError` for another number of clouds than frames, and for an empty one.
    """
    if len(clouds) != len(x):
        raise ValueError(f"got {len(clouds)} clouds for {len(x)} frames")
    if not all(len(cloud) for cloud in clouds):
        raise ValueError(f"frame {[len(c) for c in clouds].index(0)} has no points")
    most = min(POINTS, max(map(len, clouds)))
    drawn = [_drawn(cloud, most, frame) for frame, cloud in enumerate(clouds)]
    rows = [np.resize(cloud, (most, 3)) for cloud in drawn]  # repeated where too few
    weights = [_weights(min(len(cloud), most), most) for cloud in clouds]
    found = _distances(jnp.asarray(rows, float), jnp.asarray(weights, float), jnp.asarray(x), faces)
    finite = np.isfinite(x).all(axis=(1, 2))
    return np.where(finite, np.asarray(found, float), np.nan)


def _drawn(cloud: np.ndarray, most: int, frame: int) -> np.ndarray:
    if len(cloud) <= most:
        return cloud
    return cloud[np.random.default_rng([0, frame]).choice(len(cloud), most, replace=False)]


def _weights(count: int, most: int) -> np.ndarray:
    """Shares of a mean over `count` points that are repeated to `most`."""
    times = np.bincount(np.arange(most) % count, minlength=count)
    return 1 / (count * np.resize(times, most))


@eqx.filter_jit
def _distances(
    points: Float[Array, "frame point 3"],
    weights: Float[Array, "frame point"],
    x: Float[Array, "frame vertex 3"],
    faces: Int[Array, "face 3"],
) -> Float[Array, " frame"]:
    def of_frame(frame):
        points, weights, x = frame
        face, places = nearest(points, x, faces)
        gap = points - jnp.einsum("pk,pki->pi", places, x[faces[face]])
        return jnp.sum(weights * length(gap))

    return jax.lax.map(of_frame, (points, weights, x))
