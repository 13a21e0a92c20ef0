"""Samples of strain in the elements of a sheet, triangles or quadrilaterals.

The deformation gradient at a sample is linear in the element's corners: F = sum_c x_c g_c^T, with
the gradients g_c of the corners' shape functions. A triangle has one sample. A quadrilateral of a
grid is bilinear, with 2 x 2 Gauss points: it bends in its plane and folds along lines where a
triangle would stretch, and favours neither of its diagonals.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

GAUSS = 1 / 3**0.5  # places of two points on (-1, 1)


class StrainSamples(eqx.Module):
    """The samples of all elements.

    - `corners`: vertices of each element.
    - `gradients`: of the corners' shape functions in material coordinates, [1/m].
    - `areas`: rest area that each sample stands for, [m^2].
    - `hidden_waves`: wavenumber of the longest wrinkles that an element does not show, along warp
      and weft, [1/m]; None: its compression is never that of wrinkles.
    """

    corners: Int[Array, "element corner"]
    gradients: Float[Array, "element sample corner 2"]
    areas: Float[Array, "element sample"]
    hidden_waves: Float[Array, "element 2"] | None

    @classmethod
    def of_triangles(
        cls, rest: Float[np.ndarray, "vertex 2"], faces: Int[np.ndarray, "face 3"]
    ) -> "StrainSamples":
        """One sample in each counter-clockwise triangle of a mesh at rest [m]."""
        edges = rest[faces[:, 1:]] - rest[faces[:, :1]]  # (face, edge, material axis)
        inverse = np.linalg.inv(edges.transpose(0, 2, 1))
        gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        return cls._of(faces, gradients[:, None], np.linalg.det(edges)[:, None] / 2)

    @classmethod
    def of_grid(
        cls, spacing: tuple[float, float], shape: tuple[int, int], wrinkling: bool = False
    ) -> "StrainSamples":
        """Four samples in each cell of a grid of `shape` vertices, [m] apart along warp and weft.

        The corners of a cell are (0, 0), (1, 0), (1, 1) and (0, 1). Of `wrinkling` cells the
        compression gives way (`r2s.materials.wrinkling`).
        """
        corners = cells(shape)
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        along = signs * (1 + signs * (GAUSS * signs)[:, None])[..., ::-1] / 2  # of (sample, corner)
        gradients = np.broadcast_to(along / np.array(spacing), (len(corners), 4, 4, 2))
        areas = np.full((len(corners), 4), np.prod(spacing) / 4)
        # nodes can take a wave of two cells, but not one of a single cell
        waves = np.broadcast_to(2 * np.pi / np.array(spacing), (len(corners), 2))
        hidden_waves = jnp.asarray(waves, float) if wrinkling else None
        return cls._of(corners, gradients, areas, hidden_waves)

    @classmethod
    def _of(cls, corners, gradients, areas, hidden_waves=None) -> "StrainSamples":
        return cls(
            jnp.asarray(corners, int),
            jnp.asarray(gradients, float),
            jnp.asarray(areas, float),
            hidden_waves,
        )

    def strains(self, x: Float[Array, "vertex 3"]) -> Float[Array, "element sample 3"]:
        """Green strain (E11, E22, 2 E12) [-] of every sample, at positions [m]."""
        of_element = jax.vmap(green_strain, in_axes=(None, 0))
        return jax.vmap(of_element)(x[self.corners], self.gradients)


def on_samples(function: Callable, *arrays: Any) -> Any:
    """`function` of every sample, of pytrees of arrays whose first axes are (element, sample).

    It maps over one long axis: rows of an element's four samples leave vector units idle.
    """
    first = jax.tree.leaves(arrays)[0].shape[:2]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), arrays)
    mapped = jax.vmap(function)(*flat)
    return jax.tree.map(lambda leaf: leaf.reshape(*first, *leaf.shape[1:]), mapped)


def cells(shape: tuple[int, int]) -> Int[np.ndarray, "cell 4"]:
    """The vertices (0, 0), (1, 0), (1, 1) and (0, 1) of each cell of a grid of `shape` vertices."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([corner.ravel() for corner in corners], axis=1)


def green_strain(
    corners: Float[Array, "corner 3"], gradients: Float[Array, "corner 2"]
) -> Float[Array, " 3"]:
    """Green strain (E11, E22, 2 E12) [-] of a sample, E = (F^T F - 1) / 2.

    `corners` are positions [m], `gradients` those of their shape functions [1/m].
    """
    # from one corner on, as the gradients add up to zero: places in the world would cost precision
    edges = jnp.stack([corner - corners[0] for corner in corners[1:]], axis=1)
    deformation = edges @ gradients[1:]  # the images of the unit warp and weft vectors
    warp, weft = deformation[:, 0], deformation[:, 1]
    return jnp.stack([(warp @ warp - 1) / 2, (weft @ weft - 1) / 2, warp @ weft])
