"""Matrices with couplings outside their pattern: solved by iteration, they are solved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import dense

from r2s.mesh.mesh import rectangle
from r2s.solvers.implicit.linear.system import Elimination, Far, apply_inverse, prepare

MESH = rectangle((1.0, 1.0), (6, 6))
COUNT = 36
FREE = jnp.ones(COUNT, bool).at[jnp.array([0, 5])].set(False)
EQUATIONS = Elimination.make(MESH)


def blocks(least: float):
    """A symmetric matrix over the mesh with eigenvalues from `least` [-] on."""
    random = np.random.default_rng(0)
    matrix = np.zeros((COUNT, 3, COUNT, 3))
    rows, columns = np.asarray(EQUATIONS.pattern.rows), np.asarray(EQUATIONS.pattern.columns)
    matrix[rows, :, columns] = random.normal(size=(len(rows), 3, 3))
    matrix = matrix.reshape(3 * COUNT, -1)
    matrix = matrix + matrix.T
    matrix += (least - np.linalg.eigvalsh(matrix)[0]) * np.eye(3 * COUNT)
    return jnp.asarray(matrix.reshape(COUNT, 3, COUNT, 3)[rows, :, columns])


def far(stiffness: float) -> Far:
    """Springs between distant vertices, as contact makes them; the last one is none."""
    random = np.random.default_rng(1)
    weights = np.array([1.0, -0.5, -0.3, -0.2])
    axes = random.normal(size=(12, 3))
    matrices = np.einsum("a,pi,b,pj->paibj", weights, axes, weights, axes) * stiffness
    matrices[-1] = 0
    stencils = np.stack([random.choice(COUNT, 4, replace=False) for _ in axes])
    return Far(jnp.asarray(stencils), jnp.asarray(matrices))


def whole(blocks, far: Far):
    """The whole matrix, that of the identity where vertices are held."""
    matrix = np.array(dense(EQUATIONS.pattern, blocks)).reshape(COUNT, 3, COUNT, 3)
    for stencil, part in zip(np.asarray(far.stencils), np.asarray(far.matrices), strict=True):
        for i, row in enumerate(stencil):
            for j, column in enumerate(stencil):
                matrix[row, :, column] += part[i, :, j]
    held = np.flatnonzero(~np.asarray(FREE))
    matrix[held], matrix[:, :, held] = 0, 0
    matrix[held, :, held] = np.eye(3)
    return matrix.reshape(3 * COUNT, -1)


def inverse(blocks, far: Far, is_definite: bool):
    """`apply_inverse` of the matrix, as a function of the right-hand side."""
    system = prepare(EQUATIONS, blocks, far, FREE, is_definite)
    return jax.jit(lambda b: apply_inverse(EQUATIONS, system, b, is_definite))


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize(("least", "is_definite"), [(1.0, True), (1.0, False), (-3.0, False)])
@pytest.mark.parametrize("stiffness", [1.0, 1e3])
def test_the_solution_solves(least, is_definite, stiffness):
    matrix, right = blocks(least), jax.random.normal(jax.random.key(0), (COUNT, 3))
    expected = np.linalg.solve(whole(matrix, far(stiffness)), np.ravel(right))
    found = inverse(matrix, far(stiffness), is_definite)(right)
    tolerance = 1e-6 if is_definite else 1e-9  # a search needs no more
    assert np.linalg.norm(np.ravel(found) - expected) < tolerance * np.linalg.norm(expected)


@pytest.mark.slow(group="cloth")
def test_the_transpose_of_the_solution_is_the_solution():
    apply = inverse(blocks(1.0), far(10.0), False)
    assert np.all(np.asarray(apply(jnp.zeros((COUNT, 3)))) == 0)
    right, left = jax.random.normal(jax.random.key(0), (2, COUNT, 3))
    _, transposed = jax.vjp(apply, right)
    assert jnp.sum(transposed(left)[0] * right) == pytest.approx(
        float(jnp.sum(left * apply(right)))
    )


def test_where_it_does_not_converge_it_says_so():
    # the blocks are definite, the whole is not: conjugate gradients have no business there
    found = inverse(blocks(1.0), far(-1e3), True)(jnp.ones((COUNT, 3)))
    exact = np.linalg.solve(whole(blocks(1.0), far(-1e3)), np.ones(3 * COUNT))
    wrong = np.linalg.norm(np.ravel(found) - exact) > 1e-3 * np.linalg.norm(exact)
    assert not wrong or np.all(np.isnan(np.asarray(found)))
