"""The search for pairs, against looking at every one of them."""

from itertools import combinations, product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.mesh.mesh import rectangle
from r2s.solvers.contact.broad_phase import (
    Pairs,
    all_pairs,
    build_bvh,
    candidate_pairs,
    candidate_pairs_in_tree,
)
from r2s.solvers.contact.proximity import closest_weights, separation

SIZE = 0.2  # of the sheets' sides, [m]

found_near = eqx.filter_jit(candidate_pairs)
found_in_tree = eqx.filter_jit(candidate_pairs_in_tree)


def sheet(shape):
    mesh = rectangle((SIZE, SIZE), shape)
    return np.asarray(mesh.faces), np.asarray(mesh.rest)


def crumpled(rest, seed: int, travel: float = 0.01, dtype=np.float64):
    """A sheet in folds at random at the start and end of a motion of some `travel` [m]."""
    draw = np.random.default_rng(seed)
    waves, phases = draw.normal(size=(2, 5)) * 20, draw.uniform(0, 6, 5)
    folds = np.cos(rest @ waves + phases) @ draw.normal(size=(5, 3)) * 0.01
    start = np.pad(0.7 * rest, ((0, 0), (0, 1))) + folds + draw.normal(size=folds.shape) * 2e-3
    drift = 3 * draw.normal(size=(1, 3))
    end = start + travel * (drift + draw.normal(size=start.shape))
    return start.astype(dtype), end.astype(dtype)


def as_set(pairs: Pairs):
    """The pairs, each as its kind and its two bodies; fails when one is there twice."""
    real = np.asarray(pairs.is_real)
    stencils, is_edges = np.asarray(pairs.stencils)[real], np.asarray(pairs.is_edges)[real]

    def split(s, e):
        return (e, frozenset([frozenset(s[: 1 + e]), frozenset(s[1 + e :])]))

    found = {split(s, e) for s, e in zip(stencils.tolist(), is_edges.tolist(), strict=True)}
    assert len(found) == len(stencils)
    return found


def test_all_pairs_of_a_small_mesh_are_all_of_its_pairs():
    faces, _ = sheet((3, 4))
    corners = [frozenset(face) for face in faces.tolist()]
    sides = {frozenset(side) for face in corners for side in combinations(face, 2)}
    vertices = [frozenset([vertex]) for vertex in range(12)]
    met = {
        (False, frozenset(pair))
        for pair in product(vertices, corners)
        if pair[1].isdisjoint(pair[0])
    }
    crossed = {
        (True, frozenset(pair)) for pair in combinations(sides, 2) if pair[1].isdisjoint(pair[0])
    }
    assert as_set(all_pairs(faces)) == met | crossed


def test_a_mesh_without_pairs_is_an_error():
    with pytest.raises(ValueError, match="no pairs"):
        all_pairs(np.array([[0, 1, 2]]))


def is_near_one_by_one(stencil, is_edges, start, end, reach):
    """Whether the boxes around the two bodies of a pair come within reach."""

    def swept(part):
        return np.concatenate([start[part], end[part]])

    first, second = swept(stencil[: 1 + is_edges]), swept(stencil[1 + is_edges :])
    below = first.min(axis=0) <= second.max(axis=0) + reach
    above = second.min(axis=0) <= first.max(axis=0) + reach
    return bool(np.all(below & above))


@pytest.mark.parametrize("reach", [0.0, 5e-3])
def test_near_pairs_are_those_whose_boxes_are(reach):
    faces, rest = sheet((5, 5))
    pairs, (start, end) = all_pairs(faces), crumpled(rest, 0)
    found, is_over = found_near(pairs, start, end, jnp.asarray(reach), len(pairs.is_real))
    every = zip(np.asarray(pairs.stencils), np.asarray(pairs.is_edges).astype(int), strict=True)
    is_near = [is_near_one_by_one(*pair, start, end, reach) for pair in every]
    kept = Pairs(pairs.stencils, pairs.is_edges, jnp.asarray(is_near))
    assert as_set(found) == as_set(kept)
    assert not is_over
    assert 10 < sum(is_near) < 0.9 * len(is_near)


def test_no_pair_that_comes_within_reach_is_left_out():
    faces, rest = sheet((5, 5))
    pairs, (start, end), reach = all_pairs(faces), crumpled(rest, 1), 5e-3
    found, _ = found_near(pairs, start, end, jnp.asarray(reach), len(pairs.is_real))

    @jax.jit
    def distances(x):
        corners = x[pairs.stencils]
        weights = jax.vmap(closest_weights)(corners, pairs.is_edges)
        return jnp.linalg.norm(jax.vmap(separation)(corners, weights), axis=1)

    least = np.min([distances(start + t * (end - start)) for t in np.linspace(0, 1, 21)], axis=0)
    close = Pairs(pairs.stencils, pairs.is_edges, jnp.asarray(least < reach))
    assert as_set(close) < as_set(found)


def test_too_many_pairs_are_reported_and_the_first_are_kept():
    faces, rest = sheet((5, 5))
    pairs, (start, end) = all_pairs(faces), crumpled(rest, 0)

    def search(size):
        return found_near(pairs, start, end, jnp.asarray(5e-3), size)

    whole, _ = search(len(pairs.is_real))
    count = int(jnp.sum(whole.is_real))
    for size, expected in ((count, False), (count - 1, True)):
        found, is_over = search(size)
        assert bool(is_over) == expected
        assert np.all(found.is_real)
        assert np.array_equal(found.stencils, whole.stencils[:size])


def test_sheets_can_be_searched_at_once():
    faces, rest = sheet((5, 5))
    pairs = all_pairs(faces)
    starts, ends = (jnp.stack(x) for x in zip(*(crumpled(rest, i) for i in range(3)), strict=True))

    def search(start, end):
        return candidate_pairs(pairs, start, end, jnp.asarray(5e-3), 2000)

    found, _ = jax.jit(jax.vmap(search))(starts, ends)
    for i in range(3):
        alone, _ = search(starts[i], ends[i])
        assert eqx.tree_equal(jax.tree.map(lambda leaf, i=i: leaf[i], found), alone)


@pytest.mark.parametrize("shape", [(9, 9), (17, 17), (2, 2), (4, 7)])
def test_a_tree_has_each_face_and_each_part_once(shape):
    faces, rest = sheet(shape)
    found = build_bvh(faces, rest)

    def once(indices):
        return np.sort(indices[indices >= 0])

    assert np.array_equal(once(np.asarray(found.leaves)), np.arange(len(faces)))
    assert np.array_equal(once(np.asarray(found.vertices)), np.arange(len(rest)))
    sides = np.unique(np.sort(faces[:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2)), axis=0)
    edges = np.asarray(found.edges).reshape(-1, 2)
    assert np.array_equal(np.unique(edges[edges[:, 0] >= 0], axis=0), sides)
    assert np.sum(edges[:, 0] >= 0) == len(sides)

    def own(face):
        return set(np.ravel(found.edges[face]).tolist()) | set(found.vertices[face].tolist())

    assert all(own(i) <= {-1, *face} for i, face in enumerate(faces.tolist()))


CAPACITY = {(2, 2): 10, (4, 7): 3000, (9, 9): 12_000, (17, 17): 50_000}


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((2, 2), np.float64),
        ((4, 7), np.float64),
        ((9, 9), np.float64),
        ((9, 9), np.float32),
        ((17, 17), np.float64),
    ],
)
def test_a_tree_finds_the_same(shape, dtype):
    faces, rest = sheet(shape)
    pairs, boxes, size = all_pairs(faces), build_bvh(faces, rest), CAPACITY[shape]
    for seed, travel, reach in ((0, 1e-3, 0.0), (1, 2e-3, 1e-3), (2, 4e-3, 3e-3)):
        start, end = map(jnp.asarray, crumpled(rest, seed, travel, dtype))
        expected, is_over = found_near(pairs, start, end, jnp.asarray(reach, dtype), size)
        found, is_over_too = found_in_tree(boxes, start, end, jnp.asarray(reach, dtype), size)
        assert not is_over and not is_over_too
        assert as_set(found) == as_set(expected)
        assert shape == (2, 2) or np.any(found.is_real)


@pytest.mark.slow(group="cloth")
def test_a_tree_reports_too_many():
    faces, rest = sheet((9, 9))
    boxes, (start, end) = build_bvh(faces, rest), crumpled(rest, 1)

    def search(size, nodes):
        return found_in_tree(boxes, start, end, jnp.asarray(1e-3), size, nodes)

    whole, is_over = search(12_000, 12_000)
    count = int(jnp.sum(whole.is_real))
    assert not is_over
    assert search(count - 1, 12_000)[1]
    assert search(12_000, 300)[1]
