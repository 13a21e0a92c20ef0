"""Vectors as tuples of arrays, one for each component: loops over them vectorise."""

from jaxtyping import Array

Vector = tuple[Array, Array, Array]


def add(*vectors: Vector) -> Vector:
    """The sum."""
    total = vectors[0]
    for other in vectors[1:]:
        total = total[0] + other[0], total[1] + other[1], total[2] + other[2]
    return total


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: Array | float, a: Vector) -> Vector:
    """A number times a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


def dot(a: Vector, b: Vector) -> Array:
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
