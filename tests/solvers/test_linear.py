"""Sparse matrices over a mesh: elements add up, and they are solved by factors or iteration."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from conftest import dense, two_of

from r2s.mesh.mesh import Mesh, rectangle
from r2s.solvers.implicit.band import Band
from r2s.solvers.implicit.dissection import Dissection
from r2s.solvers.implicit.system import (
    Elimination,
    Far,
    Pattern,
    apply_inverse,
    assemble,
    pinned,
    prepare,
    product,
)

# compiled once for each mesh, for all tests
factored = jax.jit(lambda order, blocks: order.factor(blocks))
pivoted = jax.jit(lambda order, blocks: order.factor(blocks, is_definite=False))
solved = jax.jit(lambda order, factors, right: order.solve(factors, right))


def scattered() -> Mesh:
    """The Delaunay triangles of random points."""
    points = np.random.default_rng(3).random((120, 2))
    points = points[np.unique(scipy.spatial.Delaunay(points).simplices)]
    return Mesh.make(points, scipy.spatial.Delaunay(points).simplices)


MESHES = {
    "one face": lambda: rectangle((1.0, 1.0), (2, 2)),
    "square": lambda: rectangle((1.0, 1.0), (9, 9)),
    "strip": lambda: rectangle((1.0, 0.01), (40, 2)),
    "scattered": scattered,
    "two pieces": lambda: two_of(rectangle((1.0, 1.0), (6, 7))),
}


@pytest.fixture(scope="module", params=itertools.product(MESHES, ("band", "dissection")), ids=str)
def problem(request):
    """An elimination, elements of a random positive definite matrix over it, and its blocks."""
    mesh = MESHES[request.param[0]]()
    random = np.random.default_rng(0)

    def elements(count, corners):
        roots = random.normal(size=(count, 3 * corners, 3 * corners))
        return jnp.asarray((roots @ roots.transpose(0, 2, 1)).reshape(-1, corners, 3, corners, 3))

    corners = mesh.samples.corners
    parts = elements(*corners.shape), elements(len(mesh.hinges), 4)
    vertices = jnp.tile(jnp.eye(3), (len(mesh.rest), 1, 1))
    equations = Elimination.make(mesh, order=request.param[1])
    blocks = jax.jit(assemble)(equations.pattern, vertices, samples=parts[0], hinges=parts[1])
    return mesh, equations, parts, blocks


def test_elements_add_up(problem):
    mesh, equations, parts, blocks = problem
    matrix = np.zeros((len(mesh.rest), 3, len(mesh.rest), 3))
    for elements, matrices in zip((mesh.samples.corners, mesh.hinges), parts, strict=True):
        for element, part in zip(np.asarray(elements), np.asarray(matrices), strict=True):
            np.add.at(matrix, np.ix_(element, range(3), element, range(3)), part)
    matrix = matrix.reshape(3 * len(mesh.rest), -1) + np.eye(3 * len(mesh.rest))
    assert dense(equations.pattern, blocks) == pytest.approx(matrix, rel=1e-12, abs=1e-9)


def test_the_factor_solves_and_its_solution_is_its_own_transpose(problem):
    mesh, equations, _, blocks = problem
    right, other = jnp.asarray(np.random.default_rng(1).normal(size=(2, len(mesh.rest), 3)))
    factors = factored(equations.order, blocks)
    x = solved(equations.order, factors, right)
    expected = np.linalg.solve(np.asarray(dense(equations.pattern, blocks)), right.ravel())
    assert np.asarray(x).ravel() == pytest.approx(expected, rel=1e-8, abs=1e-9)
    assert product(equations.pattern, blocks, x) == pytest.approx(np.asarray(right), abs=1e-8)
    (back,) = jax.linear_transpose(lambda b: solved(equations.order, factors, b), right)(other)
    assert jnp.sum(back * right) == pytest.approx(float(jnp.sum(other * x)), rel=1e-8)


def test_an_indefinite_matrix_has_no_factor_but_one_by_pivoting(problem):
    mesh, equations, _, blocks = problem
    vertex = equations.pattern.diagonal[len(mesh.rest) // 2]
    bad, right = blocks.at[vertex, 0, 0].add(-500.0), jnp.ones((len(mesh.rest), 3))
    matrix = np.asarray(dense(equations.pattern, bad))
    assert np.linalg.eigvalsh(matrix)[0] < 0
    x = solved(equations.order, factored(equations.order, bad), right)
    assert not np.all(np.isfinite(x))
    x = solved(equations.order, pivoted(equations.order, bad), right)
    expected = np.linalg.solve(matrix, np.ones(len(matrix)))
    assert np.asarray(x).ravel() == pytest.approx(expected, rel=1e-7, abs=1e-9)


def test_held_vertices_do_not_move(problem):
    mesh, equations, _, blocks = problem
    free = jnp.ones(len(mesh.rest), bool).at[jnp.array([0, 2])].set(False)
    right = jnp.where(free[:, None], jnp.ones((len(mesh.rest), 3)), 0.0)
    held = pinned(equations.pattern, blocks, free)
    x = solved(equations.order, factored(equations.order, held), right)
    assert np.all(np.asarray(x)[[0, 2]] == 0)
    force = np.asarray(product(equations.pattern, blocks, x))[np.asarray(free)]
    assert force == pytest.approx(np.ones_like(force), abs=1e-8)


def test_a_wide_mesh_is_dissected_and_a_narrow_one_is_a_band():
    square, long = rectangle((1.0, 1.0), (90, 90)), rectangle((9.0, 1.0), (180, 20))
    assert isinstance(Elimination.make(square).order, Dissection)
    narrow = Elimination.make(long).order
    assert isinstance(narrow, Band) and narrow.width == 2 * 20 + 2


def test_a_pattern_holds_more_vertices_than_squares_fit_in_32_bits():
    last = np.array([[59_998, 59_999]], np.int32)
    pattern = Pattern.make(60_000, {"edge": last})
    assert np.asarray(pattern.rows)[-3:].tolist() == [59_998, 59_999, 59_999]
    assert np.asarray(pattern.columns)[-3:].tolist() == [59_999, 59_998, 59_999]


COUNT = 36
FREE = jnp.ones(COUNT, bool).at[jnp.array([0, 5])].set(False)


@pytest.fixture(scope="module")
def square():
    return Elimination.make(rectangle((1.0, 1.0), (6, 6)))


def coupled(square, least: float, stiffness: float):
    """Blocks with eigenvalues from `least` [-] on, springs between distant vertices, as contact
    makes them, and the whole matrix, that of the identity where vertices are held."""
    random = np.random.default_rng(0)
    matrix = np.zeros((COUNT, 3, COUNT, 3))
    rows, columns = np.asarray(square.pattern.rows), np.asarray(square.pattern.columns)
    matrix[rows, :, columns] = random.normal(size=(len(rows), 3, 3))
    matrix = matrix.reshape(3 * COUNT, -1)
    matrix = matrix + matrix.T
    matrix += (least - np.linalg.eigvalsh(matrix)[0]) * np.eye(3 * COUNT)
    matrix = matrix.reshape(COUNT, 3, COUNT, 3)
    blocks = jnp.asarray(matrix[rows, :, columns])
    weights, axes = np.array([1.0, -0.5, -0.3, -0.2]), random.normal(size=(12, 3))
    parts = np.einsum("a,pi,b,pj->paibj", weights, axes, weights, axes) * stiffness
    parts[-1] = 0  # this one is none
    stencils = np.stack([random.choice(COUNT, 4, replace=False) for _ in axes])
    for stencil, part in zip(stencils, parts, strict=True):
        np.add.at(matrix, np.ix_(stencil, range(3), stencil, range(3)), part)
    held = np.flatnonzero(~np.asarray(FREE))
    matrix[held], matrix[:, :, held] = 0, 0
    matrix[held, :, held] = np.eye(3)
    return blocks, Far(jnp.asarray(stencils), jnp.asarray(parts)), matrix.reshape(3 * COUNT, -1)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize(("least", "is_definite"), [(1.0, True), (1.0, False), (-3.0, False)])
@pytest.mark.parametrize("stiffness", [1.0, 1e3])
def test_couplings_outside_the_pattern_are_solved_by_iteration(
    square, least, is_definite, stiffness
):
    blocks, far, whole = coupled(square, least, stiffness)
    right, left = jax.random.normal(jax.random.key(0), (2, COUNT, 3))
    system = prepare(square, blocks, far, FREE, is_definite)
    apply = jax.jit(lambda b: apply_inverse(square, system, b, is_definite))
    x, expected = np.ravel(apply(right)), np.linalg.solve(whole, np.ravel(right))
    tolerance = 1e-6 if is_definite else 1e-9  # a search needs no more
    assert np.linalg.norm(x - expected) < tolerance * np.linalg.norm(expected)
    assert np.all(np.asarray(apply(jnp.zeros((COUNT, 3)))) == 0)
    back = jax.vjp(apply, right)[1](left)[0]
    assert jnp.sum(back * right) == pytest.approx(float(jnp.sum(left * apply(right))), rel=1e-4)


def test_where_the_iteration_does_not_converge_it_says_so(square):
    # the blocks are definite, the whole is not: conjugate gradients have no business there
    blocks, far, whole = coupled(square, 1.0, -1e3)
    system = prepare(square, blocks, far, FREE)
    x = jax.jit(lambda b: apply_inverse(square, system, b))(jnp.ones((COUNT, 3)))
    exact = np.linalg.solve(whole, np.ones(3 * COUNT))
    wrong = np.linalg.norm(np.ravel(x) - exact) > 1e-3 * np.linalg.norm(exact)
    assert not wrong or np.all(np.isnan(np.asarray(x)))
