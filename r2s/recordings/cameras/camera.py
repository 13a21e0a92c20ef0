"""A depth camera: which points of a surface it sees."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

DEPTH_TOLERANCE = 0.006  # [m]: samples of one surface in one pixel differ in depth by less


class Camera(eqx.Module):
    """A pinhole camera without distortion.

    - `position`, `target`: where it is and what it looks at, [m]; up in its image is up.
    - `focal_length`: in pixels.
    - `resolution`: pixels (across, down).
    """

    position: Float[Array, " 3"]
    target: Float[Array, " 3"]
    focal_length: float = eqx.field(static=True, default=200.0)
    resolution: tuple[int, int] = eqx.field(static=True, default=(160, 120))

    def project(
        self, points: Float[Array, "point 3"]
    ) -> tuple[Float[Array, "point 2"], Float[Array, " point"]]:
        """Pixel coordinates (across, down) and depth [m] of points [m]."""
        forward = self.target - self.position
        forward = forward / jnp.sqrt(forward @ forward)
        right = jnp.cross(forward, jnp.array([0.0, 0.0, 1.0], points.dtype))
        right = right / jnp.sqrt(right @ right)
        down = jnp.cross(forward, right)
        offset = points - self.position[None]
        depth = offset @ forward
        plane = jnp.stack([offset @ right, offset @ down], axis=1)
        centre = jnp.array(self.resolution, points.dtype) / 2
        return centre[None] + self.focal_length * plane / depth[:, None], depth

    def sees(self, points: Float[Array, "point 3"]) -> Bool[Array, " point"]:
        """Which points [m] of a densely sampled surface are in view and not behind others.

        A z-buffer: of the points in a pixel, those within `DEPTH_TOLERANCE` of the nearest.
        """
        pixel, depth = self.project(points)
        index, inside = self._pixels(pixel, depth)
        nearest = jax.ops.segment_min(depth, index, self.resolution[0] * self.resolution[1] + 1)
        return inside & (depth <= nearest[index] + DEPTH_TOLERANCE)

    def _pixels(self, pixel, depth) -> tuple[Int[Array, " point"], Bool[Array, " point"]]:
        across, down = jnp.floor(pixel[:, 0]).astype(int), jnp.floor(pixel[:, 1]).astype(int)
        width, height = self.resolution
        inside = (depth > 0) & (across >= 0) & (across < width) & (down >= 0) & (down < height)
        return jnp.where(inside, down * width + across, width * height), inside
