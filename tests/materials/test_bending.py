"""Bending: cylinders, and the angle of a hinge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import directional_difference, few
from hypothesis import given
from hypothesis import strategies as st

from r2s.mesh.bends import hinge_angle, unwrapped
from r2s.mesh.mesh import rectangle

STIFFNESS = 3e-5  # [N m]
gradient = jax.jit(jax.grad(hinge_angle))
angle_of = jax.jit(hinge_angle)


def bending_energy(mesh, x):
    """Energy [J] in the curvatures alone."""
    return STIFFNESS / 2 * jnp.sum(mesh.hinge_area * mesh.hinge_bends.curvatures_at(x) ** 2)


def rolled(mesh, radius, axis):
    """Positions on a cylinder of which material `axis` goes round."""
    along, across = mesh.rest[:, axis], mesh.rest[:, 1 - axis]
    round_, up = radius * jnp.sin(along / radius), radius * (1 - jnp.cos(along / radius))
    return jnp.stack([round_, across, up] if axis == 0 else [across, round_, up], axis=1)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("radius", [0.1, -0.1])
def test_a_rolled_sheet_has_the_energy_of_the_cylinder(axis, radius):
    # half a cell at either end has no hinge, so the energy converges as the cells get smaller
    size = (0.2, 0.3)
    for cells in (2, 4, 8):
        shape = [4, 4]
        shape[axis] = cells + 1
        mesh = rectangle(size, (shape[0], shape[1]))
        area = size[0] * size[1] * (1 - 1 / cells)
        expected = STIFFNESS / radius**2 / 2 * area
        assert bending_energy(mesh, rolled(mesh, radius, axis)) == pytest.approx(expected, rel=1e-9)


def hinge(angle):
    """A hinge along x whose left triangle lies in the plane and whose right one is bent down."""
    right = [0.4, -np.cos(angle), -np.sin(angle)]
    return jnp.array([[0.0, 0, 0], [1, 0, 0], [0.3, 1, 0], right])


@given(st.floats(-3.1, 3.1))
@few
def test_the_angle_is_signed_and_goes_up_to_a_full_fold(angle):
    # downwards, so that the normals point away from each other, is positive
    assert angle_of(hinge(angle)) == pytest.approx(angle, abs=1e-12)
    assert angle_of(hinge(angle)[jnp.array([1, 0, 3, 2])]) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, -1.5, 3.0])
def test_gradient_of_the_angle_agrees_with_differences(angle):
    corners = hinge(angle)
    direction = jax.random.normal(jax.random.key(0), corners.shape)
    expected = directional_difference(angle_of, corners, direction, 1e-5)
    found = jnp.sum(gradient(corners) * direction)
    assert found == pytest.approx(float(expected), rel=1e-7)  # 1e-10 and rounding


@given(angle=st.floats(-np.pi, np.pi), near=st.floats(-10.0, 10.0))
def test_an_unwrapped_angle_differs_by_whole_turns_and_is_nearest(angle, near):
    found = float(unwrapped(jnp.asarray(angle), jnp.asarray(near)))
    turns = (found - angle) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert abs(found - near) <= np.pi * (1 + 1e-9)
