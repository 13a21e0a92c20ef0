"""A symmetric matrix of blocks, made ready to be solved; with couplings outside its pattern too.

What lies in the pattern of a mesh is factorised. Contact couples any places of a sheet: on a small
mesh the pattern holds all pairs, on a large one what is outside is left to an iteration that the
factors precondition.
"""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.linear.dissection import levels
from r2s.solvers.implicit.linear.factor import Band, Factor, Order, factor, solve
from r2s.solvers.implicit.linear.pattern import Pattern, pinned, product

WIDEST = 160  # vertices: of wider bands nested dissection is faster


class Elimination(eqx.Module):
    """What depends on a mesh alone in the solution of its linear systems.

    - `pattern`: the blocks of the matrix.
    - `order`: in which vertices are eliminated: a band where it is narrow, or by dissection.
    - `couples_all`: whether every pair of vertices has a block.
    """

    pattern: Pattern
    order: Order
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
        blocks = np.asarray(pattern.rows), np.asarray(pattern.columns)
        if couples_all:
            return cls(pattern, levels(rest, *blocks, leaf=len(rest)), couples_all)
        if order == "dissection":
            return cls(pattern, levels(rest, *blocks))
        band = Band.make(rest, *blocks)
        if order == "band" or (band.width <= WIDEST and jax.default_backend() == "cpu"):
            return cls(pattern, band)
        return cls(pattern, levels(rest, *blocks))


Vector = Float[Array, "vertex 3"]

ITERATIONS = 300
RESTART = 50  # of the iteration for matrices that need not be definite
TOLERATED = 1e-3  # the residual [-] above which a solution is NaN


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

    factors: Factor
    far: Far | None = None
    blocks: Float[Array, "block 3 3"] | None = None
    free: Bool[Array, " vertex"] | None = None


def prepare(
    elimination: Elimination,
    blocks: Float[Array, "block 3 3"],
    far: Far | None,
    free: Bool[Array, " vertex"],
    is_definite: bool = True,
) -> System:
    """The system of the matrix of `blocks` and `far`, for the `free` vertices.

    With `is_definite` it holds NaN where the blocks are not positive definite.
    """
    blocks = pinned(elimination.pattern, blocks, free)
    factors = factor(elimination.order, blocks, is_definite)
    return System(factors) if far is None else System(factors, far, blocks, free)


def apply_inverse(
    elimination: Elimination, system: System, right: Vector, is_definite: bool = True
) -> Vector:
    """The solution [unknowns] of the system for a right-hand side.

    It is linear in the right-hand side, so that it batches and transposes. Couplings outside the
    pattern are solved by conjugate gradients, or by GMRES if the matrix need not be definite, both
    preconditioned by the factors; NaN where they did not converge.
    """
    if system.far is None:
        return solve(elimination.order, system.factors, right)
    tags = {lx.symmetric_tag, lx.positive_semidefinite_tag} if is_definite else {lx.symmetric_tag}
    matrix, factors = (
        lx.FunctionLinearOperator(
            function, jax.ShapeDtypeStruct(right.shape, right.dtype), frozenset(tags)
        )
        for function in (
            partial(_times, elimination.pattern, system),
            partial(solve, elimination.order, system.factors),
        )
    )
    solver = _conjugate_gradients(right.dtype) if is_definite else _gmres(right.dtype)

    def solved(_, right):
        options = {"preconditioner": factors}
        # of unit size, for an absolute tolerance: a relative one is NaN at the zeros of held rows
        size = jnp.linalg.norm(right)
        unit = right / jnp.where(size > 0, size, 1)
        x = size * lx.linear_solve(matrix, unit, solver, options=options, throw=False).value
        left = jnp.linalg.norm(right - matrix.mv(x))
        return jnp.where(left <= TOLERATED * jnp.linalg.norm(right), x, jnp.nan)

    # the check of what is left is not linear: only from outside is the whole
    return jax.lax.custom_linear_solve(matrix.mv, right, solved, solved, symmetric=True)


def _conjugate_gradients(dtype: Any) -> lx.CG:
    tolerance = float(jnp.finfo(dtype).eps) ** 0.5 / 10
    return lx.CG(rtol=0.0, atol=tolerance, norm=jnp.linalg.norm, max_steps=ITERATIONS)


def _gmres(dtype: Any) -> lx.GMRES:
    return lx.GMRES(
        rtol=0.0,
        atol=50 * float(jnp.finfo(dtype).eps),
        norm=jnp.linalg.norm,
        max_steps=ITERATIONS,
        restart=RESTART,
        stagnation_iters=RESTART,
    )


def _times(pattern: Pattern, system: System, x: Vector) -> Vector:
    assert system.far is not None and system.blocks is not None and system.free is not None
    is_free = system.free[:, None]
    far = system.far.times(jnp.where(is_free, x, 0))
    return product(pattern, system.blocks, x) + jnp.where(is_free, far, 0)
