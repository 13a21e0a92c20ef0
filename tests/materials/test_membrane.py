"""Membranes: patch tests, rigid motions, springs, and which laws are isotropic or stable."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHAPE, SIZE, few, flat, rotation, stored_energy
from hypothesis import given
from hypothesis import strategies as st

from r2s._util.units import isotropic_bending, isotropic_membrane
from r2s.materials.membrane import OrthotropicMembrane, SpringMembrane
from r2s.mesh.mesh import Mesh, rectangle
from r2s.mesh.strain_samples import on_samples

CELL = SIZE / (SHAPE[0] - 1)  # side of the sheet's squares, [m]
INDEX = np.arange(25).reshape(SHAPE)
UNIFORM = {  # images of the sheet's axes in the plane
    "uniaxial": [[1.1, 0.0], [0.0, 1.0]],
    "biaxial": [[1.1, 0.0], [0.0, 0.93]],
    "simple shear": [[1.0, 0.2], [0.0, 1.0]],
}
forces = jax.jit(jax.grad(stored_energy, argnums=2))


def law(kind, *parameters):
    return kind(*(jnp.asarray(parameter, float) for parameter in parameters))


@pytest.mark.parametrize("name", UNIFORM)
@pytest.mark.parametrize("degrees", [None, 0, 30, -70])
def test_uniform_strain_is_exact(name, degrees, sheet, fabric):
    """Of quadrilaterals along the yarns, and of triangles whose yarns are turned."""
    gradient, turn, mesh = np.array(UNIFORM[name]), np.eye(2), sheet
    if degrees is not None:
        turn = np.asarray(rotation(np.deg2rad(-degrees), 2))[:2, :2]
        mesh = Mesh.make(np.asarray(sheet.rest) @ turn.T, np.asarray(sheet.faces))
    x = jnp.pad(sheet.rest @ gradient.T, ((0, 0), (0, 1))) @ rotation(0.7, 0).T
    (e11, half), (_, e22) = turn @ (gradient.T @ gradient - np.eye(2)) @ turn.T / 2
    density = (300 * e11**2 + 2 * 60 * e11 * e22 + 200 * e22**2 + 80 * (2 * half) ** 2) / 2
    found = mesh.samples.strains(x).reshape(-1, 3)
    assert found == pytest.approx(np.tile([e11, e22, 2 * half], (len(found), 1)), abs=1e-13)
    assert stored_energy(mesh, fabric, x) == pytest.approx(SIZE**2 * density, rel=1e-12)
    force = forces(mesh, fabric, x)
    inner = INDEX[1:-1, 1:-1].ravel()
    assert jnp.max(jnp.abs(force[inner])) < 1e-12 * jnp.max(jnp.abs(force))


@given(st.floats(-3, 3), st.integers(0, 2), st.tuples(*[st.floats(-5, 5)] * 3))
@few
def test_rigid_motion_neither_strains_nor_pulls(sheet, fabric, angle, axis, shift):
    x = flat(sheet) @ rotation(angle, axis).T + jnp.array([shift])
    assert jnp.max(jnp.abs(sheet.samples.strains(x))) < 1e-13  # rounding of shifts up to 5 m
    assert jnp.max(jnp.abs(forces(sheet, fabric, x))) < 1e-12  # [N]


strain = st.tuples(*[st.floats(-1, 1)] * 3)
stiffness = st.floats(1, 1e4)


@given(strain, st.floats(0, 6.3), st.floats(-0.9, 0.49))
@few
def test_isotropic_law_does_not_know_the_material_axes(strain, angle, poissons_ratio):
    membrane = law(OrthotropicMembrane, *isotropic_membrane(1e5, poissons_ratio, 1e-3))
    e11, e22, shear = strain
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = turn @ np.array([[e11, shear / 2], [shear / 2, e22]]) @ turn.T
    other = jnp.array([turned[0, 0], turned[1, 1], 2 * turned[0, 1]])
    reference = float(membrane.energy_density(jnp.array(strain)))
    assert membrane.energy_density(other) == pytest.approx(reference, rel=1e-9, abs=1e-12)


def test_isotropic_strip_has_youngs_modulus_and_poissons_ratio():
    c11, c12, c22, c33 = isotropic_membrane(2e6, 0.3, 5e-4)
    assert c11 - c12 * c12 / c22 == pytest.approx(2e6 * 5e-4)  # pulled with free sides
    assert c12 / c22 == pytest.approx(0.3)
    assert c33 == pytest.approx(2e6 / (2 * 1.3) * 5e-4)
    assert isotropic_bending(2e6, 0.3, 5e-4) == pytest.approx(c11 * 5e-4**2 / 12)


@given(stiffness, stiffness, stiffness, st.floats(-0.999, 0.999), strain)
@few
def test_energy_is_positive_for_any_strain(c11, c22, c33, coupling, strain):
    membrane = law(OrthotropicMembrane, c11, coupling * (c11 * c22) ** 0.5, c22, c33)
    density = membrane.energy_density(jnp.array(strain))
    assert density >= 4e-4 * sum(e**2 for e in strain)  # the least eigenvalue is >= 1 - 0.999


@eqx.filter_jit
def membrane_energy(mesh, membrane, x):
    """Energy [J] in the strains alone."""
    return jnp.sum(
        mesh.samples.areas * on_samples(membrane.energy_density, mesh.samples.strains(x))
    )


def spring_energy(x, first, second, constant, length):
    """Energy [J] of springs [N/m] between vertices, of a rest length [m]."""
    stretched = np.linalg.norm(x[second] - x[first], axis=-1)
    return np.sum(constant / 2 * (stretched - length) ** 2)


def structural_springs(x, warp, weft):
    """Energy [J] of springs on the edges along warp and weft, those of the boundary by half."""
    half = np.array([0.5, 1, 1, 1, 0.5])
    along = spring_energy(x, INDEX[:-1], INDEX[1:], warp * half, CELL)
    return along + spring_energy(x, INDEX[:, :-1], INDEX[:, 1:], weft * half[:, None], CELL)


def diagonal_springs(x, constant):
    """Energy [J] of springs on both diagonals of every cell."""
    pairs = (INDEX[:-1, :-1], INDEX[1:, 1:]), (INDEX[1:, :-1], INDEX[:-1, 1:])
    return sum(spring_energy(x, *pair, constant, 2**0.5 * CELL) for pair in pairs)


@pytest.mark.parametrize("seed", range(3))
def test_structural_energy_is_that_of_springs_on_the_edges(seed):
    sheet = rectangle((SIZE, SIZE), SHAPE, "falling")
    noise = np.random.default_rng(seed).normal(size=(25, 3))
    x = np.asarray(flat(sheet)) + 0.3 * CELL * noise  # in any position, bent too
    found = membrane_energy(sheet, law(SpringMembrane, 30.0, 20.0, 0.0), jnp.asarray(x))
    assert found == pytest.approx(structural_springs(x, 30.0, 20.0), rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_energy_of_a_uniform_strain_is_that_of_all_springs(seed, sheet):
    gradient = np.eye(2, 3) + 0.4 * np.random.default_rng(seed).normal(size=(2, 3))
    x = np.asarray(sheet.rest) @ gradient
    membrane = law(SpringMembrane, 25.0, 25.0, 18.0)  # a diagonal is longer than its share
    found = membrane_energy(sheet, membrane, jnp.asarray(x))
    springs = structural_springs(x, 25.0, 25.0) + diagonal_springs(x, 9.0)
    assert found == pytest.approx(springs, rel=1e-12)


def test_small_strains_of_springs_see_an_orthotropic_membrane():
    membrane = law(SpringMembrane, 30.0, 20.0, 8.0)
    stiffness = jax.hessian(membrane.energy_density)(jnp.zeros(3))
    c11, c22, c12, c33 = 30 + 4, 20 + 4, 4, 4  # C12 = C33: Cauchy's relation
    expected = np.array([[c11, c12, 0], [c12, c22, 0], [0, 0, c33]])
    assert np.asarray(stiffness) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "strain",  # (E11, E22, 2 E12): of the warp, of all, of the bias; inside out
    [(-0.5, 0.0, 0.0), (-0.5, -0.5, 0.0), (-0.25, -0.25, -0.5), (-2.0, -2.0, 1.0)],
)
def test_collapsed_springs_have_finite_energy_and_force(strain):
    membrane, strain = law(SpringMembrane, 30.0, 20.0, 8.0), jnp.array(strain)
    value, force = jax.value_and_grad(membrane.energy_density)(strain)
    assert 0 < value <= (30 + 20 + 2 * 8) / 2
    assert jnp.all(jnp.isfinite(force))
    assert jnp.all(jnp.isfinite(jax.hessian(membrane.energy_density)(strain)))
