"""The search for pairs, against looking at every one of them."""

from itertools import combinations, product

import equinox as eqx
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


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize(
    ("shape", "size", "dtype"),
    [
        ((2, 2), 10, np.float64),
        ((4, 7), 3000, np.float64),
        ((9, 9), 12_000, np.float32),
        ((17, 17), 50_000, np.float64),
    ],
)
def test_a_tree_finds_the_same_or_says_that_there_are_more(shape, size, dtype):
    faces, rest = sheet(shape)
    pairs, boxes = all_pairs(faces), build_bvh(faces, rest)
    for seed, travel, reach in ((0, 1e-3, 0.0), (1, 2e-3, 1e-3), (2, 4e-3, 3e-3)):
        start, end = map(jnp.asarray, crumpled(rest, seed, travel, dtype))
        expected, is_over = found_near(pairs, start, end, jnp.asarray(reach, dtype), size)
        found, is_over_too = found_in_tree(boxes, start, end, jnp.asarray(reach, dtype), size, size)
        assert not is_over and not is_over_too
        assert as_set(found) == as_set(expected)
        count = int(jnp.sum(found.is_real))
        assert shape == (2, 2) or count > 0
    if count > 1:
        for few in ((count - 1, size), (size, 100)):
            assert found_in_tree(boxes, start, end, jnp.asarray(reach, dtype), *few)[1]
