"""A symmetric matrix of blocks, made ready to be solved; with couplings outside its pattern too.

What lies in the pattern of a mesh is factorised. Contact couples any places of a sheet: on a small
mesh the pattern holds all pairs, on a large one what is outside is left to an iteration that the
factors precondition.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.cloth.linear.dissection import Level
from r2s.cloth.linear.factor import Factor, factor, solve
from r2s.cloth.linear.pattern import Pattern, pinned, product

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

    factors: tuple[Factor, ...]
    far: Far | None = None
    blocks: Float[Array, "block 3 3"] | None = None
    free: Bool[Array, " vertex"] | None = None


def prepare(
    levels: Sequence[Level],
    pattern: Pattern,
    blocks: Float[Array, "block 3 3"],
    far: Far | None,
    free: Bool[Array, " vertex"],
    is_definite: bool = True,
) -> System:
    """The system of the matrix of `blocks` and `far`, for the `free` vertices.

    With `is_definite` it holds NaN where the blocks are not positive definite.
    """
    blocks = pinned(pattern, blocks, free)
    factors = factor(levels, blocks, is_definite)
    return System(factors) if far is None else System(factors, far, blocks, free)


def apply_inverse(
    levels: Sequence[Level],
    pattern: Pattern,
    system: System,
    right: Vector,
    is_definite: bool = True,
) -> Vector:
    """The solution [unknowns] of the system for a right-hand side.

    Linear in it, so that it batches and transposes. Where there are couplings outside the pattern:
    conjugate gradients, or GMRES if it need not be definite; NaN where they did not converge.
    """
    if system.far is None:
        return solve(levels, system.factors, right)
    times = lambda x: _times(pattern, system, x)
    around = lambda b: solve(levels, system.factors, b)
    iterate = _conjugate_gradients if is_definite else _minimal_residual
    find = lambda times, b: iterate(times, around, b)
    return jax.lax.custom_linear_solve(times, right, find, symmetric=True)


def _times(pattern: Pattern, system: System, x: Vector) -> Vector:
    assert system.far is not None and system.blocks is not None and system.free is not None
    is_free = system.free[:, None]
    far = system.far.times(jnp.where(is_free, x, 0))
    return product(pattern, system.blocks, x) + jnp.where(is_free, far, 0)


def _conjugate_gradients(times: Callable, around: Callable, b: Vector) -> Vector:
    tolerance = float(jnp.finfo(b.dtype).eps) ** 0.5 / 10
    x, _ = jax.scipy.sparse.linalg.cg(times, b, tol=tolerance, maxiter=ITERATIONS, M=around)
    return _checked(times, x, b)


def _minimal_residual(times: Callable, around: Callable, b: Vector) -> Vector:
    tolerance = 50 * float(jnp.finfo(b.dtype).eps)
    x, _ = jax.scipy.sparse.linalg.gmres(
        times, b, tol=tolerance, restart=RESTART, maxiter=ITERATIONS // RESTART, M=around
    )
    return _checked(times, x, b)


def _checked(times: Callable, x: Vector, b: Vector) -> Vector:
    left = jnp.linalg.norm(b - times(x))
    return jnp.where(left <= TOLERATED * jnp.linalg.norm(b), x, jnp.nan)
