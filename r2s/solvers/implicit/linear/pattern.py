"""Which pairs of vertices share an element, and the sum of element matrices into blocks."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Pattern(eqx.Module):
    """The blocks of a sparse symmetric matrix over the vertices of a mesh.

    - `rows`, `columns`: the vertices of every block, both triangles and the diagonal, sorted.
    - `diagonal`: the block of every vertex with itself.
    - `slots`: by kind of element, the block to which each pair of its vertices adds.
    """

    rows: Int[Array, " block"]
    columns: Int[Array, " block"]
    diagonal: Int[Array, " vertex"]
    slots: dict[str, Int[Array, "element corner corner"]]

    @classmethod
    def make(
        cls,
        count: int,
        elements: Mapping[str, Int[np.ndarray, "element corner"]],
        is_full: bool = False,
    ) -> "Pattern":
        """The pattern of `count` vertices and their elements; full, with a block for every pair."""
        every = np.arange(count, dtype=np.int64)
        elements = {kind: each.astype(np.int64) for kind, each in elements.items()}  # squares fit
        keys = {kind: e[:, :, None] * count + e[:, None, :] for kind, e in elements.items()}
        own = every * count + every
        blocks = np.unique(np.concatenate([own, *(key.ravel() for key in keys.values())]))
        blocks = np.arange(count * count) if is_full else blocks
        slots = {kind: np.searchsorted(blocks, key) for kind, key in keys.items()}
        return cls(
            rows=jnp.asarray(blocks // count, int),
            columns=jnp.asarray(blocks % count, int),
            diagonal=jnp.asarray(np.searchsorted(blocks, own), int),
            slots={kind: jnp.asarray(slot, int) for kind, slot in slots.items()},
        )


def assemble(
    pattern: Pattern,
    vertices: Float[Array, "vertex 3 3"],
    **elements: Float[Array, "_ _ 3 _ 3"],
) -> Float[Array, "block 3 3"]:
    """The blocks that the matrices of vertices and of elements add up to.

    `elements` are matrices (corner, axis, corner, axis) by kind.
    """
    blocks = jnp.zeros((pattern.rows.shape[0], 3, 3), vertices.dtype)
    blocks = blocks.at[pattern.diagonal].add(vertices, unique_indices=True)
    for kind, matrices in elements.items():
        blocks = add_elements(blocks, pattern.slots[kind], matrices)
    return blocks


def add_elements(
    blocks: Float[Array, "block 3 3"],
    slots: Int[Array, "element corner corner"],
    matrices: Float[Array, "element corner 3 corner 3"],
) -> Float[Array, "block 3 3"]:
    """The blocks with element matrices added, each pair of corners at its slot."""
    return blocks.at[slots].add(matrices.transpose(0, 1, 3, 2, 4))


def add_between(
    pattern: Pattern,
    blocks: Float[Array, "block 3 3"],
    stencils: Int[Array, "pair 4"],
    matrices: Float[Array, "pair 4 3 4 3"],
) -> Float[Array, "block 3 3"]:
    """The blocks of a full pattern with the matrices of any four vertices added."""
    count = pattern.diagonal.shape[0]
    return add_elements(blocks, stencils[:, :, None] * count + stencils[:, None, :], matrices)


def pinned(
    pattern: Pattern, blocks: Float[Array, "block 3 3"], free: Bool[Array, " vertex"]
) -> Float[Array, "block 3 3"]:
    """The blocks with rows and columns of vertices that are not free made those of the identity."""
    both = free[pattern.rows] & free[pattern.columns]
    blocks = jnp.where(both[:, None, None], blocks, 0)
    held = jnp.where(free[:, None, None], 0, jnp.eye(3, dtype=blocks.dtype))
    return blocks.at[pattern.diagonal].add(held, unique_indices=True)


def raise_diagonal(
    pattern: Pattern, blocks: Float[Array, "block 3 3"], share: Float[Array, ""] | float
) -> Float[Array, "block 3 3"]:
    """The blocks with the diagonal of the matrix raised by a share [-] of itself."""
    raised = 1 + share * jnp.eye(3, dtype=blocks.dtype)
    return blocks.at[pattern.diagonal].multiply(raised, unique_indices=True)


def product(
    pattern: Pattern, blocks: Float[Array, "block 3 3"], x: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The matrix times a vector."""
    parts = jnp.einsum("bij,bj->bi", blocks, x[pattern.columns])
    return jnp.zeros_like(x).at[pattern.rows].add(parts, indices_are_sorted=True)
