"""Vectors, and matrices of three by three, as tuples of arrays: loops over them vectorise.

An array is one component of many vectors, side by side.
"""

import jax
from jaxtyping import Array, Float

Number = Float[Array, "..."]  # of one, or of many; what all share may be one
Vector = tuple[Number, Number, Number]
Matrix = tuple[Vector, Vector, Vector]  # rows


def columns(vectors: Array) -> Vector:
    """The components of vectors (vector, 3, ...)."""
    return vectors[:, 0], vectors[:, 1], vectors[:, 2]


def add(*vectors: Vector) -> Vector:
    """The sum."""
    total = vectors[0]
    for other in vectors[1:]:
        total = total[0] + other[0], total[1] + other[1], total[2] + other[2]
    return total


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: Number | float, a: Vector) -> Vector:
    """A number times a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


def dot(a: Vector, b: Vector) -> Number:
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def times(matrix: Matrix, vector: Vector) -> Vector:
    """Matrix times vector."""
    return dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector)


def transposed(matrix: Matrix) -> Matrix:
    """Columns for rows."""
    one, two, three = zip(*matrix, strict=True)
    return one, two, three


def product(left: Matrix, right: Matrix) -> Matrix:
    """Matrix times matrix."""
    columns = transposed(right)
    return times(columns, left[0]), times(columns, left[1]), times(columns, left[2])


def inverse(matrix: Matrix) -> Matrix:
    """By cofactors; infinite where the matrix is singular."""
    part, (one, two, three) = _adjugate(matrix)
    return scale(part, one), scale(part, two), scale(part, three)


@jax.jit
def solve(matrix: Matrix, right: Vector) -> Vector:
    """The solution of three equations (Cramer's rule)."""
    part, rows = _adjugate(matrix)
    one, two, three = times(rows, right)
    return part * one, part * two, part * three


def _adjugate(matrix: Matrix) -> tuple[Number, Matrix]:
    """One over the determinant, and the matrix that gives the inverse times it."""
    first, second, third = matrix
    cofactors = cross(second, third), cross(third, first), cross(first, second)
    return 1 / dot(first, cofactors[0]), transposed(cofactors)
