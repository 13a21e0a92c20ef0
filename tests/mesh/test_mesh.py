"""Meshes: what a sheet's triangles and hinges add up to, and what is no sheet."""

from collections import Counter

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.mesh.mesh import ELEMENTS, Mesh, borders, corner, rectangle

sides = st.floats(0.01, 10)
counts = st.integers(2, 6)
few = settings(max_examples=15, deadline=None)
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@given(st.tuples(sides, sides), st.tuples(counts, counts))
@few
def test_areas_add_up_to_the_sheet(size, shape):
    mesh = rectangle(size, shape)
    area = size[0] * size[1]
    assert jnp.sum(mesh.area) == pytest.approx(area, rel=1e-12)
    assert jnp.sum(mesh.vertex_area) == pytest.approx(area, rel=1e-12)


@given(st.tuples(counts, counts))
@few
def test_every_inner_edge_has_one_hinge(shape):
    mesh = rectangle((1.0, 2.0), shape)
    sides = np.concatenate([np.asarray(mesh.faces)[:, [i, (i + 1) % 3]] for i in range(3)])
    shared = Counter(tuple(sorted(side)) for side in sides.tolist())
    inner = sorted(edge for edge, number in shared.items() if number == 2)
    assert sorted(tuple(sorted(hinge)) for hinge in mesh.hinges[:, :2].tolist()) == inner


@pytest.mark.slow(group="cloth")
@given(st.tuples(counts, counts))
@few
def test_the_borders_go_once_around_the_sheet(shape):
    mesh = rectangle((1.0, 2.0), shape)
    face, corner_of = np.nonzero(np.asarray(borders(mesh)))
    faces = np.asarray(mesh.faces)
    ends = np.stack([faces[face, (corner_of + i) % 3] for i in (1, 2)])
    first, second = np.asarray(mesh.rest)[ends]
    assert np.linalg.norm(second - first, axis=1).sum() == pytest.approx(6, rel=1e-12)
    assert np.any(np.isin((first + second) / 2, (0, 1, 2)), axis=1).all()


def test_a_hinge_lies_between_its_two_triangles_and_measures_them(sheet):
    faces = {frozenset(face) for face in sheet.faces.tolist()}
    for start, end, left, right in sheet.hinges.tolist():
        assert {frozenset((start, end, left)), frozenset((start, end, right))} <= faces
    straight, diagonal = (np.isclose(sheet.hinge_length, 0.05 * x) for x in (1, 2**0.5))
    assert np.all(straight | diagonal) and diagonal.sum() == 16
    assert sheet.hinge_area == pytest.approx(0.05**2, rel=1e-12)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("elements", ELEMENTS)
@given(st.tuples(sides, sides), st.tuples(counts, counts))
@few
def test_samples_share_out_the_sheet_and_know_the_slope_of_a_plane(elements, size, shape):
    samples = rectangle(size, shape, elements).samples
    rest = rectangle(size, shape).rest
    assert jnp.sum(samples.areas) == pytest.approx(size[0] * size[1], rel=1e-12)
    height = rest @ jnp.array([0.3, -0.7])
    slopes = jnp.einsum("ec,esca->esa", height[samples.corners], samples.gradients)
    assert slopes.reshape(-1, 2) == pytest.approx(np.tile([0.3, -0.7], (slopes.size // 2, 1)))


def test_corners_are_where_they_are_called():
    mesh = rectangle((0.3, 0.7), (3, 4))
    expected = {"origin": [0, 0], "warp": [0.3, 0], "weft": [0, 0.7], "opposite": [0.3, 0.7]}
    assert {name: mesh.rest[corner((3, 4), name)].tolist() for name in expected} == expected
    with pytest.raises(ValueError, match="a corner is one of"):
        corner((3, 4), "middle")


OVERLAPPING = np.array([[0.0, 0.0], [1.0, 0.0], [0.3, 1.0], [0.7, 1.0]])
BAD = {
    "clockwise": (SQUARE, [[0, 1, 2], [0, 3, 2]], "face 1 .* counter-clockwise"),
    "degenerate": (np.array([[0.0, 0], [1, 0], [2, 0]]), [[0, 1, 2]], "not degenerate"),
    "non-manifold edge": (
        np.array([[0.0, 0], [1, 0], [0.3, 1], [0.7, 1], [0.5, -1]]),
        [[0, 1, 2], [0, 1, 3], [1, 0, 4]],
        "edge 0-1 belongs to 3 faces",
    ),
    "isolated vertex": (SQUARE, [[0, 1, 2]], r"leave out \[3\]"),
    "index out of range": (SQUARE, [[0, 1, 2], [0, 2, 3], [0, 2, 4]], "they go from 0 to 4"),
    "negative index": (SQUARE, [[0, 1, 2], [0, 2, 3], [0, 2, -1]], "they go from -1 to 3"),
    "not finite": (SQUARE * np.nan, [[0, 1, 2], [0, 2, 3]], "finite"),
    "wrong shape of rest": (np.ones((3, 3)), [[0, 1, 2]], r"\(vertex, 2\).* got shape \(3, 3\)"),
    "wrong shape of faces": (SQUARE, [[0, 1, 2, 3]], r"\(face, 3\), got shape \(1, 4\)"),
    "faces that are no integers": (SQUARE, [[0.0, 1, 2], [0, 2, 3]], "must be integers"),
    "faces that overlap": (OVERLAPPING, [[0, 1, 2], [0, 1, 3]], "must not overlap"),
    "no faces": (np.zeros((3, 2)), np.zeros((0, 3), int), "at least one face"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_sheet_is_refused_with_the_reason(name, unchecked):
    rest, faces, reason = BAD[name]
    with pytest.raises(ValueError, match=reason):
        Mesh.make(rest, np.array(faces))


@pytest.mark.parametrize(
    ("size", "shape", "reason"),
    [
        ((-1.0, 1.0), (3, 3), "sides > 0 m"),
        ((1.0, 1.0), (1, 3), ">= 2 vertices"),
        ((300.0, 300.0), (3, 3), "expected 0.001 to 50.0 m: are they in millimetres"),
        ((1e-4, 1e-4), (3, 3), "expected 0.001 to 50.0 m"),
    ],
)
def test_a_rectangle_of_no_sheet_is_refused(size, shape, reason):
    with pytest.raises(ValueError, match=reason):
        rectangle(size, shape)
