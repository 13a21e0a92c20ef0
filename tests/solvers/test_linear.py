"""Sparse matrices over a mesh: elements add up, and the factor solves."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from conftest import dense

from r2s.mesh.mesh import Mesh, rectangle
from r2s.solvers.implicit.linear.dissection import levels
from r2s.solvers.implicit.linear.factor import Band, factor, solve
from r2s.solvers.implicit.linear.pattern import Pattern, assemble, pinned, product
from r2s.solvers.implicit.linear.system import Elimination

# compiled once for each mesh, for all tests
factored = jax.jit(factor, static_argnames="is_definite")
solved = jax.jit(solve)


def scattered(count: int) -> Mesh:
    """The Delaunay triangles of random points."""
    points = np.random.default_rng(3).random((count, 2))
    points = points[np.unique(scipy.spatial.Delaunay(points).simplices)]
    return Mesh.make(points, scipy.spatial.Delaunay(points).simplices)


def two_pieces() -> Mesh:
    """Two sheets that do not touch."""
    one = rectangle((1.0, 1.0), (6, 7))
    rest, faces = np.asarray(one.rest), np.asarray(one.faces)
    return Mesh.make(np.concatenate([rest, rest + [2.0, 0.0]]), np.concatenate([faces, faces + 42]))


MESHES = {
    "one face": lambda: rectangle((1.0, 1.0), (2, 2)),
    "square": lambda: rectangle((1.0, 1.0), (9, 9)),
    "strip": lambda: rectangle((1.0, 0.01), (40, 2)),
    "scattered": lambda: scattered(120),
    "two pieces": two_pieces,
}


def orders(mesh, pattern):
    """A mesh's equations by either order of elimination."""
    places = np.asarray(mesh.rest), np.asarray(pattern.rows), np.asarray(pattern.columns)
    return {"band": Band.make(*places), "dissection": levels(*places)}


@pytest.fixture(scope="module", params=itertools.product(MESHES, ("band", "dissection")), ids=str)
def problem(request):
    """A mesh, and the blocks of a random positive definite matrix over it."""
    mesh = MESHES[request.param[0]]()
    random = np.random.default_rng(0)

    def elements(count, corners):
        roots = random.normal(size=(count, 3 * corners, 3 * corners))
        return jnp.asarray((roots @ roots.transpose(0, 2, 1)).reshape(-1, corners, 3, corners, 3))

    corners = mesh.samples.corners
    parts = elements(*corners.shape), elements(len(mesh.hinges), 4)
    vertices = jnp.tile(jnp.eye(3), (len(mesh.rest), 1, 1))
    pattern = Elimination.make(mesh).pattern
    equations = Elimination(pattern, orders(mesh, pattern)[request.param[1]])
    blocks = jax.jit(assemble)(equations.pattern, vertices, samples=parts[0], hinges=parts[1])
    return mesh, equations, parts, blocks


def test_elements_add_up(problem):
    mesh, equations, parts, blocks = problem
    matrix = np.zeros((len(mesh.rest), 3, len(mesh.rest), 3))
    for elements, matrices in zip((mesh.samples.corners, mesh.hinges), parts, strict=True):
        for element, part in zip(np.asarray(elements), np.asarray(matrices), strict=True):
            for i, row in enumerate(element):
                for j, column in enumerate(element):
                    matrix[row, :, column] += part[i, :, j]
    size = 3 * len(mesh.rest)
    matrix = matrix.reshape(size, size) + np.eye(size)
    assert np.asarray(dense(equations.pattern, blocks)) == pytest.approx(
        matrix, rel=1e-12, abs=1e-9
    )


def test_the_factor_solves(problem):
    mesh, equations, _, blocks = problem
    right = jnp.asarray(np.random.default_rng(1).normal(size=(len(mesh.rest), 3)))
    x = solved(equations.order, factored(equations.order, blocks), right)
    expected = np.linalg.solve(np.asarray(dense(equations.pattern, blocks)), right.ravel())
    assert np.asarray(x).ravel() == pytest.approx(expected, rel=1e-8, abs=1e-9)
    assert np.asarray(product(equations.pattern, blocks, x)) == pytest.approx(
        np.asarray(right), abs=1e-8
    )


@pytest.mark.slow(group="cloth")
def test_every_depth_of_dissection_and_every_group_gives_the_same(problem):
    mesh, equations, _, blocks = problem
    right = jnp.ones((len(mesh.rest), 3))
    expected = solved(equations.order, factored(equations.order, blocks), right)
    rows, columns = np.asarray(equations.pattern.rows), np.asarray(equations.pattern.columns)
    places = np.asarray(mesh.rest), rows, columns
    depths = [levels(*places, leaf) for leaf in (6, 1000)]
    for others in (*depths, *(Band.make(*places, size) for size in (1, 3, 1000))):
        found = solved(others, factored(others, blocks), right)
        assert np.asarray(found) == pytest.approx(np.asarray(expected), rel=1e-8, abs=1e-10)


def test_an_indefinite_matrix_has_no_factor(problem):
    mesh, equations, _, blocks = problem
    vertex = len(mesh.rest) // 2
    bad = blocks.at[equations.pattern.diagonal[vertex], 0, 0].set(-1.0)
    x = solved(equations.order, factored(equations.order, bad), jnp.ones((len(mesh.rest), 3)))
    assert not np.all(np.isfinite(x))


def test_an_indefinite_matrix_is_solved_when_asked(problem):
    mesh, equations, _, blocks = problem
    vertex = len(mesh.rest) // 2
    bad = blocks.at[equations.pattern.diagonal[vertex], 0, 0].add(-500.0)
    right = jnp.ones((len(mesh.rest), 3))
    x = solved(equations.order, factored(equations.order, bad, is_definite=False), right)
    matrix = np.asarray(dense(equations.pattern, bad))
    assert np.linalg.eigvalsh(matrix)[0] < 0
    expected = np.linalg.solve(matrix, np.ones(len(matrix)))
    assert np.asarray(x).ravel() == pytest.approx(expected, rel=1e-7, abs=1e-9)


def test_a_wide_mesh_is_dissected_and_a_narrow_one_is_a_band():
    square, long = rectangle((1.0, 1.0), (90, 90)), rectangle((9.0, 1.0), (180, 20))
    assert not isinstance(Elimination.make(square).order, Band)
    narrow = Elimination.make(long).order
    assert isinstance(narrow, Band) and narrow.width == 2 * 20 + 2


def test_a_pattern_holds_more_vertices_than_squares_fit_in_32_bits():
    last = np.array([[59_998, 59_999]], np.int32)
    pattern = Pattern.make(60_000, {"edge": last})
    assert np.asarray(pattern.rows)[-3:].tolist() == [59_998, 59_999, 59_999]
    assert np.asarray(pattern.columns)[-3:].tolist() == [59_999, 59_998, 59_999]


def test_held_vertices_do_not_move(problem):
    mesh, equations, _, blocks = problem
    free = jnp.ones(len(mesh.rest), bool).at[jnp.array([0, 2])].set(False)
    right = jnp.where(free[:, None], jnp.ones((len(mesh.rest), 3)), 0.0)
    x = solved(
        equations.order, factored(equations.order, pinned(equations.pattern, blocks, free)), right
    )
    assert np.all(np.asarray(x)[[0, 2]] == 0)
    force = np.asarray(product(equations.pattern, blocks, x))[np.asarray(free)]
    assert force == pytest.approx(np.ones_like(force), abs=1e-8)


def test_a_solution_is_transposed_by_itself(problem):
    mesh, equations, _, blocks = problem
    factors = factored(equations.order, blocks)
    right, other = jnp.asarray(np.random.default_rng(2).normal(size=(2, len(mesh.rest), 3)))

    def run(b):
        return solved(equations.order, factors, b)

    (back,) = jax.linear_transpose(run, right)(other)
    assert np.asarray(back) == pytest.approx(np.asarray(run(other)), rel=1e-8, abs=1e-10)
