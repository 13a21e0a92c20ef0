"""The factor of a sparse symmetric matrix of blocks, by the order in which it is eliminated."""

from jaxtyping import Array, Float

from r2s.solvers.implicit.linear.band import Band, BandFactor, factor_band, solve_band
from r2s.solvers.implicit.linear.dissection import Level
from r2s.solvers.implicit.linear.fronts import FrontFactor, factor_fronts, solve_fronts

Order = Band | tuple[Level, ...]
Factor = BandFactor | tuple[FrontFactor, ...]


def factor(order: Order, blocks: Float[Array, "block 3 3"], is_definite: bool = True) -> Factor:
    """The factor of a matrix.

    With `is_definite` by Cholesky: NaN when the matrix is not positive definite. Without, by
    elimination with pivoting among vertices that are eliminated together, for any symmetric matrix
    but a singular one.
    """
    if isinstance(order, Band):
        return factor_band(order, blocks, is_definite)
    return factor_fronts(order, blocks, is_definite)


def solve(
    order: Order, factor: Factor, right: Float[Array, "vertex 3"]
) -> Float[Array, "vertex 3"]:
    """The solution of the factored matrix times x = `right`."""
    if isinstance(order, Band):
        assert isinstance(factor, BandFactor)
        return solve_band(order, factor, right)
    assert not isinstance(factor, BandFactor)
    return solve_fronts(order, factor, right)
