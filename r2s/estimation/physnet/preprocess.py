"""The grey image that the network sees, from measured or simulated depth."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.estimation.physnet.views import LAYER, View, depth_of
from r2s.recordings.recording import Recording

ALIKE = 2  # least number of 8 neighbours within `views.LAYER` of a pixel that is no stray
SPECK = 5  # the same among 5 x 5 pixels, where `REACH` has spread measured points
AROUND = 5  # least number of 8 neighbours with depth, from which a hole is filled
PASSES = 2  # of filling: holes of up to about 4 pixels across
DARKEST = 0.2  # grey of the farthest depth; a pixel without depth is 0
REACH = 0.25  # half the side of the square of a measured point, over the distance between points
LEAST = 20  # least number of pixels with depth, in an image of 64 x 64


class Flaws(NamedTuple):
    """The errors of training images. Shares and scales are upper ends, drawn anew for each image.

    The defaults are from the effect of the typical flaws in `r2s.recordings.synthetic_rgbd`
    and of clouds of two cameras on images of 64 x 64: 5 to 22 % of the pixels at a border are lost,
    up to 10 % beside it
    are gained, and a tenth of the depths there are more than 6 to 8 mm wrong.

    - `noise`: standard deviation of depth at 1 m, which grows with its square, [m].
    - `holes`: share of the pixels that lose their depth.
    - `strays`: share of the pixels with a random depth, the same in every image.
    - `lost`: share of the pixels at a border, also one between layers, that lose their depth.
    - `gained`: share of the pixels just outside of a border that get the depth inside.
    - `flying`: scale of the Laplacian error of depth at a border, [m].
    """

    noise: float = 2e-3
    holes: float = 0.15
    strays: float = 0.003
    lost: float = 0.25
    gained: float = 0.1
    flying: float = 5e-3


def grey(view: View, depth: Float[Array, "down across"]) -> Float[Array, "down across"]:
    """The grey image of a depth image [m]: 1 for the nearest depth, `DARKEST` for the farthest,
    0 for none. Strays are dropped before holes are filled.
    """
    depth = filled(without_strays(depth))
    shade = (view.far - depth) / (view.far - view.near)
    return jnp.where(depth > 0, DARKEST + (1 - DARKEST) * jnp.clip(shade, 0, 1), 0)


def without_strays(depth: Float[Array, "down across"]) -> Float[Array, "down across"]:
    """Depth [m] without the pixels that have fewer than `ALIKE` neighbours near their depth."""
    around = _around(depth)
    near = (around > 0) & (jnp.abs(around - depth[None]) < LAYER)
    return jnp.where(jnp.sum(near, axis=0) >= ALIKE, depth, 0)


def filled(depth: Float[Array, "down across"]) -> Float[Array, "down across"]:
    """Depth [m] where pixels without depth get the mean of at least `AROUND` neighbours."""
    for _ in range(PASSES):
        number, mean = _mean_around(_around(depth))
        depth = jnp.where((depth > 0) | (number < AROUND), depth, mean)
    return depth


def _around(values: Float[Array, "down across"], reach: int = 1) -> Float[Array, "n down across"]:
    """The neighbours of every pixel, 8 for a `reach` of 1; 0 outside of the image."""
    padded, (rows, columns) = jnp.pad(values, reach), values.shape
    shifts = [(i, j) for i in range(2 * reach + 1) for j in range(2 * reach + 1)]
    shifts.remove((reach, reach))
    return jnp.stack([padded[i : i + rows, j : j + columns] for i, j in shifts])


def _mean_around(around: Float[Array, "n down across"]):
    """How many neighbours of every pixel have a depth, and the mean of those [m]."""
    number = jnp.sum(around > 0, axis=0, dtype=around.dtype)
    return number, jnp.sum(around, axis=0) / jnp.maximum(number, 1)


def flawed(
    depth: Float[Array, "down across"], view: View, flaws: Flaws, key: Array
) -> Float[Array, "down across"]:
    """Depth [m] with noise, holes, strays and ragged borders, as cameras and clouds give it."""
    key_shares, key_border, key_noise, key_holes, key_stray, key_where = jax.random.split(key, 6)
    share = jax.random.uniform(key_shares, (4,), depth.dtype)
    depth = _ragged(depth, flaws, share[:3], key_border)
    error = flaws.noise * depth**2 * jax.random.normal(key_noise, depth.shape, depth.dtype)
    keys = key_holes, key_stray, key_where
    hole, stray, where = (jax.random.uniform(k, depth.shape, depth.dtype) for k in keys)
    depth = jnp.where((hole >= flaws.holes * share[3]) & (depth > 0), depth + error, 0)
    return jnp.where(stray < flaws.strays, view.near + (view.far - view.near) * where, depth)


def _ragged(depth: Float[Array, "down across"], flaws: Flaws, share: Float[Array, "3"], key: Array):
    """Depth [m] with lost, gained and wrong pixels at its borders."""
    key_lost, key_error = jax.random.split(key)
    around, there = _around(depth), depth > 0
    number, beside = _mean_around(around)
    border = there & jnp.any((around == 0) | (jnp.abs(around - depth[None]) > LAYER), axis=0)
    outside = ~there & (number > 0)
    chance = jax.random.uniform(key_lost, depth.shape, depth.dtype)
    gained = outside & (chance < flaws.gained * share[0])
    lost = border & (chance < flaws.lost * share[1])
    error = flaws.flying * share[2] * jax.random.laplace(key_error, depth.shape, depth.dtype)
    depth = jnp.where(gained, beside, jnp.where(lost, 0, depth))
    return jnp.where((border | outside) & (depth > 0), depth + error, depth)


def of_points(
    view: View, points: Float[Array, "point 3"], mask: Bool[Array, " point"]
) -> Float[Array, "down across"]:
    """The depth image [m] of measured points [m], as large as that of the surface they lie on.

    Simulated surfaces are sampled up to their borders, which measured points do not reach.
    """
    covered = jnp.sum(depth_of(view, points, mask) > 0)
    apart = jnp.sqrt(covered / jnp.maximum(jnp.sum(mask), 1)).astype(points.dtype)
    return without_specks(depth_of(view, points, mask, REACH * apart))


def without_specks(depth: Float[Array, "down across"]) -> Float[Array, "down across"]:
    """Depth [m] without the pixels that have fewer than `SPECK` around them near their depth."""
    near = jnp.abs(_around(depth, 2) - depth[None]) < 2 * LAYER
    return jnp.where((depth > 0) & (1 + jnp.sum(near, axis=0) >= SPECK), depth, 0)


def of_clouds(view: View, recording: Recording, frames: tuple[int, ...]) -> np.ndarray:
    """The images (frame, down, across) of a recording's clouds at some frames.

    Raises `ValueError` as `of_depths` does.
    """
    see = jax.jit(jax.vmap(partial(of_points, view)))
    chosen = np.array(frames)
    depth = see(recording.points[chosen], recording.mask[chosen])
    return of_depths(view, np.asarray(depth), recording.info.name, frames)


def of_depths(
    view: View,
    depths: Float[np.ndarray, "frame down across"],
    name: str = "depth images",
    frames: tuple[int, ...] = (),
) -> np.ndarray:
    """The images of depths [m] in the view's own pixels.

    Raises `ValueError` that names the frame when depths have another size, are not finite, are
    missing, are not in metres or are not where the view looks.
    """
    if depths.ndim != 3 or depths.shape[1:] != (view.size, view.size):
        raise ValueError(
            f"{name}: expected images of {view.size} x {view.size} pixels, found {depths.shape}"
        )
    least = LEAST * view.size**2 / 64**2
    for number, depth in enumerate(depths):
        at = f"{name}, frame {frames[number] if frames else number}"
        seen = depth > 0
        if not np.isfinite(depth).all():
            raise ValueError(f"{at}: {(~np.isfinite(depth)).sum()} depths are not finite")
        if seen.sum() < least:
            raise ValueError(
                f"{at}: {seen.sum()} pixels have a depth, expected at least {least:.0f}: the frame "
                f"is empty, the view looks elsewhere, or the units are not metres"
            )
        middle = float(np.median(depth[seen]))
        if not view.near / 2 <= middle <= 2 * view.far:
            raise ValueError(
                f"{at}: the median depth is {middle:g} m, the view expects {view.near:g} to "
                f"{view.far:g} m: give depths in metres, from the view's camera"
            )
    return np.asarray(jax.jit(jax.vmap(partial(grey, view)))(jnp.asarray(depths, float)))
