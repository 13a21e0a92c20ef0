"""Sparse symmetric matrices of 3 x 3 blocks over the vertices of a mesh, and their solution.

What lies in the pattern of a mesh is factorised. Contact couples any places of a sheet: on a small
mesh the pattern holds all pairs, on a large one what is outside is left to an iteration that the
factors precondition.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.band import Band
from r2s.solvers.implicit.dissection import Dissection

Vector = Float[Array, "vertex 3"]
Blocks = Float[Array, "block 3 3"]

WIDEST = 160  # vertices: of wider bands nested dissection is faster
ITERATIONS = 300
RESTART = 50  # of the iteration for matrices that need not be definite
TOLERATED = 1e-3  # the residual [-] above which a solution is NaN


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
        vertices = np.arange(count, dtype=np.int64)
        keys = {}
        for kind, element in elements.items():
            corners = element.astype(np.int64)  # squares of the number of vertices fit
            keys[kind] = corners[:, :, None] * count + corners[:, None, :]
        own = vertices * count + vertices
        blocks = np.unique(np.concatenate([own, *(key.ravel() for key in keys.values())]))
        blocks = np.arange(count * count) if is_full else blocks
        slots = {kind: jnp.asarray(np.searchsorted(blocks, key), int) for kind, key in keys.items()}
        rows, columns, diagonal = (
            jnp.asarray(array, int)
            for array in (blocks // count, blocks % count, np.searchsorted(blocks, own))
        )
        return cls(rows, columns, diagonal, slots)


def assemble(
    pattern: Pattern, vertices: Float[Array, "vertex 3 3"], **elements: Float[Array, "_ _ 3 _ 3"]
) -> Blocks:
    """The blocks that the matrices of vertices and of elements add up to.

    `elements` are matrices (corner, axis, corner, axis) by kind.
    """
    blocks = jnp.zeros((pattern.rows.shape[0], 3, 3), vertices.dtype)
    blocks = blocks.at[pattern.diagonal].add(vertices, unique_indices=True)
    for kind, matrices in elements.items():
        blocks = add_elements(blocks, pattern.slots[kind], matrices)
    return blocks


def add_elements(
    blocks: Blocks,
    slots: Int[Array, "element corner corner"],
    matrices: Float[Array, "element corner 3 corner 3"],
) -> Blocks:
    """The blocks with element matrices added, each pair of corners at its slot."""
    return blocks.at[slots].add(matrices.transpose(0, 1, 3, 2, 4))


def pinned(pattern: Pattern, blocks: Blocks, free: Bool[Array, " vertex"]) -> Blocks:
    """The blocks with rows and columns of vertices that are not free made those of the identity."""
    both = free[pattern.rows] & free[pattern.columns]
    blocks = jnp.where(both[:, None, None], blocks, 0)
    held = jnp.where(free[:, None, None], 0, jnp.eye(3, dtype=blocks.dtype))
    return blocks.at[pattern.diagonal].add(held, unique_indices=True)


def raise_diagonal(pattern: Pattern, blocks: Blocks, share: Float[Array, ""] | float) -> Blocks:
    """The blocks with the diagonal of the matrix raised by a share [-] of itself."""
    raised = 1 + share * jnp.eye(3, dtype=blocks.dtype)
    return blocks.at[pattern.diagonal].multiply(raised, unique_indices=True)


def product(pattern: Pattern, blocks: Blocks, x: Vector) -> Vector:
    """The matrix times a vector."""
    parts = jnp.einsum("bij,bj->bi", blocks, x[pattern.columns])
    return jnp.zeros_like(x).at[pattern.rows].add(parts, indices_are_sorted=True)


class Elimination(eqx.Module):
    """What depends on a mesh alone in the solution of its linear systems.

    - `pattern`: the blocks of the matrix.
    - `order`: in which vertices are eliminated: a band where it is narrow, or by dissection.
    - `couples_all`: whether every pair of vertices has a block.
    """

    pattern: Pattern
    order: Band | Dissection
    couples_all: bool = eqx.field(static=True, default=False)

    @classmethod
    def make(
        cls,
        mesh: Mesh,
        couples_all: bool = False,
        order: Literal["band", "dissection"] | None = None,
    ) -> "Elimination":
        """The elimination of a mesh that is not traced, since its sizes follow from the mesh.

        With `couples_all` any two vertices may be coupled, as self-contact does in small meshes:
        then there is no `order` to choose. None: on a CPU a band where it is narrow, elsewhere
        dissection, which launches the fewest kernels.
        """
        rest = np.asarray(mesh.rest)
        elements = {
            "samples": mesh.samples.corners,
            "hinges": mesh.hinges,
            "plate": mesh.plate.vertices,
            "plate_bends": mesh.plate.bends.vertices,
        }
        elements = {kind: np.asarray(vertices) for kind, vertices in elements.items()}
        pattern = Pattern.make(len(rest), elements, is_full=couples_all)
        matrix = rest, np.asarray(pattern.rows), np.asarray(pattern.columns)
        if couples_all:
            return cls(pattern, Dissection.make(*matrix, leaf=len(rest)), couples_all)
        if order != "dissection":
            band = Band.make(*matrix)
            if order == "band" or (band.width <= WIDEST and jax.default_backend() == "cpu"):
                return cls(pattern, band)
        return cls(pattern, Dissection.make(*matrix))


class Far(eqx.Module):
    """Couplings of any four vertices, outside of the pattern.

    - `stencils`: their vertices.
    - `matrices`: what each adds to the matrix; zero where there is none.
    """

    stencils: Int[Array, "pair 4"]
    matrices: Float[Array, "pair 4 3 4 3"]

    def times(self, x: Vector) -> Vector:
        """Their sum times a vector."""
        parts = jnp.einsum("paibj,pbj->pai", self.matrices, x[self.stencils])
        return jnp.zeros_like(x).at[self.stencils].add(parts)


class System(eqx.Module):
    """A matrix ready to be solved, in which vertices that are not free are those of the identity.

    - `factors`: of what is in the pattern.
    - `far`: what is outside; None: nothing.
    - `blocks`, `free`: what `far` needs to multiply with the whole; None without it.
    """

    factors: Any
    far: Far | None = None
    blocks: Blocks | None = None
    free: Bool[Array, " vertex"] | None = None


def prepare(
    elimination: Elimination,
    blocks: Blocks,
    far: Far | None,
    free: Bool[Array, " vertex"],
    is_definite: bool = True,
) -> System:
    """The system of the matrix of `blocks` and `far`, for the `free` vertices.

    With `is_definite` it holds NaN where the blocks are not positive definite.
    """
    blocks = pinned(elimination.pattern, blocks, free)
    factors = elimination.order.factor(blocks, is_definite)
    return System(factors) if far is None else System(factors, far, blocks, free)


def apply_inverse(
    elimination: Elimination, system: System, right: Vector, is_definite: bool = True
) -> Vector:
    """The solution [unknowns] of the system for a right-hand side.

    It is linear in the right-hand side, so that it batches and transposes. Couplings outside the
    pattern are solved by conjugate gradients, or by GMRES if the matrix need not be definite, both
    preconditioned by the factors; NaN where they did not converge.
    """
    solve = partial(elimination.order.solve, system.factors)
    if system.far is None:
        return solve(right)
    tags = {lx.symmetric_tag, lx.positive_semidefinite_tag} if is_definite else {lx.symmetric_tag}
    shape = jax.ShapeDtypeStruct(right.shape, right.dtype)
    times = partial(_times, elimination.pattern, system)
    matrix, preconditioner = (
        lx.FunctionLinearOperator(function, shape, frozenset(tags)) for function in (times, solve)
    )
    options = {"preconditioner": preconditioner}
    solver = _iteration(right.dtype, is_definite)

    def solved(_, right):
        # of unit size, for an absolute tolerance: a relative one is NaN at the zeros of held rows
        size = jnp.linalg.norm(right)
        unit = right / jnp.where(size > 0, size, 1)
        x = size * lx.linear_solve(matrix, unit, solver, options=options, throw=False).value
        left = jnp.linalg.norm(right - matrix.mv(x))
        return jnp.where(left <= TOLERATED * jnp.linalg.norm(right), x, jnp.nan)

    # the check of the residual is not linear: only from outside is the whole
    return jax.lax.custom_linear_solve(matrix.mv, right, solved, solved, symmetric=True)


def _iteration(dtype: Any, is_definite: bool) -> lx.CG | lx.GMRES:
    precision = float(jnp.finfo(dtype).eps)
    common = {"rtol": 0.0, "norm": jnp.linalg.norm, "max_steps": ITERATIONS}
    if is_definite:
        return lx.CG(atol=precision**0.5 / 10, **common)
    return lx.GMRES(atol=50 * precision, restart=RESTART, stagnation_iters=RESTART, **common)


def _times(pattern: Pattern, system: System, x: Vector) -> Vector:
    assert system.far is not None and system.blocks is not None and system.free is not None
    is_free = system.free[:, None]
    far = system.far.times(jnp.where(is_free, x, 0))
    return product(pattern, system.blocks, x) + jnp.where(is_free, far, 0)
