"""The factor of a sparse symmetric matrix of blocks, one batch of fronts a level.

Levels go from the leaves to the root. A front holds the rows of its pivots, and what its children
left over for all of its vertices; eliminating the pivots leaves a Schur complement for its parent.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.solvers.implicit.linear.dissection import Level


class FrontFactor(eqx.Module):
    """The factor of one level's fronts.

    - `inverse`: of the block of the pivots.
    - `coupling`: `inverse` times the block of pivots and boundary.
    """

    inverse: Float[Array, "node pivot pivot"]
    coupling: Float[Array, "node pivot outer"]


def factor_fronts(
    levels: Sequence[Level], blocks: Float[Array, "block 3 3"], is_definite: bool = True
) -> tuple[FrontFactor, ...]:
    """The factors of all levels, root first, as `factor.factor` makes them.

    Without `is_definite` it pivots inside the fronts.
    """
    blocks = jnp.concatenate([blocks, jnp.zeros((1, 3, 3), blocks.dtype)])
    factors: list[FrontFactor] = []
    schur = None
    for level in reversed(levels):
        inner = 3 * level.pivots.shape[1]
        rows = _pivot_rows(level, blocks)
        rest = jnp.zeros((), blocks.dtype)
        if schur is not None:
            left_over = _from_children(level, schur)
            rows, rest = rows + left_over[:, :inner], left_over[:, inner:, inner:]
        inverse = _inverses(rows[:, :, :inner], is_definite)
        coupling = inverse @ rows[:, :, inner:]
        schur = rest - rows[:, :, inner:].mT @ coupling
        factors.append(FrontFactor(inverse, coupling))
    return tuple(factors[::-1])


def solve_fronts(
    levels: Sequence[Level], factors: Sequence[FrontFactor], right: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The solution of the factored matrix times x = `right`."""
    # padding stays zero: it is coupled to nothing
    b = jnp.concatenate([right, jnp.zeros((1, 3), right.dtype)])
    for level, part in zip(reversed(levels), reversed(factors), strict=True):
        b = b.at[level.boundary].add(-_unflat(_times(part.coupling.mT, _flat(b[level.pivots]))))
    x = jnp.zeros_like(b)
    for level, part in zip(levels, factors, strict=True):
        alone = _times(part.inverse, _flat(b[level.pivots]))
        coupled = _times(part.coupling, _flat(x[level.boundary]))
        # each vertex is a pivot once; an addition, since that has a transpose
        x = x.at[level.pivots].add(_unflat(alone - coupled))
    return x[:-1]


def _pivot_rows(level: Level, blocks: Array) -> Array:
    """The matrix's rows of the pivots, those of padding from the identity."""
    nodes, pivots, front = level.blocks.shape
    rows = blocks[level.blocks].transpose(0, 1, 3, 2, 4).reshape(nodes, 3 * pivots, 3 * front)
    # where a pivot has no block with itself, it is padding
    own = jnp.diagonal(level.blocks[:, :, :pivots], axis1=1, axis2=2)
    padding = jnp.repeat((own == blocks.shape[0] - 1).astype(blocks.dtype), 3, axis=1)
    return rows + padding[:, :, None] * jnp.eye(3 * pivots, 3 * front, dtype=blocks.dtype)[None]


def _from_children(level: Level, schur: Array) -> Array:
    """The sum of the children's Schur complements, each at its place in the parent's front."""
    nodes, _, front = level.children.shape
    width = schur.shape[-1]
    schur = jnp.pad(schur, ((0, 0), (0, 3), (0, 3))).reshape(nodes, 2, width + 3, width + 3)
    places = jnp.repeat(3 * level.children, 3, axis=2) + jnp.tile(jnp.arange(3), front)[None, None]
    pick = jax.vmap(jax.vmap(lambda matrix, place: matrix[place][:, place]))
    return jnp.sum(pick(schur, places), axis=1)


def _inverses(pivots: Array, is_definite: bool) -> Array:
    """The inverses of a batch of symmetric matrices."""

    def definite(matrix):
        lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
        unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
        inverse = jax.scipy.linalg.solve_triangular(lower, unit, lower=True)
        return inverse.T @ inverse

    one = definite if is_definite else jnp.linalg.inv
    if pivots.shape[0] == 1:
        return one(pivots[0])[None]
    if jax.default_backend() == "cpu":
        return jax.lax.map(one, pivots)  # jaxlib 0.10.1 can hang in a batched factorisation
    return jax.vmap(one)(pivots)


def _times(matrices: Array, vectors: Array) -> Array:
    return jnp.einsum("nij,nj->ni", matrices, vectors)


def _flat(vectors: Array) -> Array:
    return vectors.reshape(vectors.shape[0], -1)


def _unflat(vectors: Array) -> Array:
    return vectors.reshape(vectors.shape[0], -1, 3)
