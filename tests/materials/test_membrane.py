"""Membrane: patch tests, rigid motions, and which laws are isotropic or stable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SIZE, flat, rotation, stored_energy
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s._util.units import isotropic_bending, isotropic_membrane
from r2s.materials.membrane import OrthotropicMembrane
from r2s.mesh.surface import strains

few = settings(max_examples=25, deadline=None)
UNIFORM = {  # warp and weft images in the plane
    "uniaxial": [[1.1, 0.0], [0.0, 1.0]],
    "biaxial": [[1.1, 0.0], [0.0, 0.93]],
    "simple shear": [[1.0, 0.2], [0.0, 1.0]],
}
forces = jax.jit(jax.grad(stored_energy, argnums=2))
INNER = np.arange(25).reshape(5, 5)[1:-1, 1:-1].ravel()


def law(c11, c12, c22, c33):
    return OrthotropicMembrane(*(jnp.asarray(c, float) for c in (c11, c12, c22, c33)))


@pytest.mark.parametrize("name", UNIFORM)
def test_uniform_strain_is_exact(name, sheet, fabric):
    gradient = jnp.array(UNIFORM[name])
    x = jnp.pad(sheet.rest @ gradient.T, ((0, 0), (0, 1))) @ rotation(0.7, 0).T
    green = (np.asarray(gradient).T @ np.asarray(gradient) - np.eye(2)) / 2
    e11, e22, shear = green[0, 0], green[1, 1], 2 * green[0, 1]
    density = (300 * e11**2 + 2 * 60 * e11 * e22 + 200 * e22**2 + 80 * shear**2) / 2
    # to rounding
    found = strains(sheet, x)
    assert found == pytest.approx(np.tile([e11, e22, shear], (len(found), 1)), abs=1e-13)
    assert stored_energy(sheet, fabric, x) == pytest.approx(SIZE**2 * density, rel=1e-12)
    force = forces(sheet, fabric, x)
    assert jnp.max(jnp.abs(force[INNER])) < 1e-12 * jnp.max(jnp.abs(force))


@given(st.floats(-3, 3), st.integers(0, 2), st.tuples(*[st.floats(-5, 5)] * 3))
@few
def test_rigid_motion_neither_strains_nor_pulls(sheet, fabric, angle, axis, shift):
    x = flat(sheet) @ rotation(angle, axis).T + jnp.array([shift])
    assert jnp.max(jnp.abs(strains(sheet, x))) < 1e-13  # rounding of shifts up to 5 m
    assert jnp.max(jnp.abs(forces(sheet, fabric, x))) < 1e-12  # [N]


strain = st.tuples(*[st.floats(-1, 1)] * 3)
stiffness = st.floats(1, 1e4)


@given(strain, st.floats(0, 6.3), st.floats(-0.9, 0.49))
@few
def test_isotropic_law_does_not_know_the_material_axes(strain, angle, poissons_ratio):
    membrane = law(*isotropic_membrane(1e5, poissons_ratio, 1e-3))
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
    membrane = law(c11, coupling * (c11 * c22) ** 0.5, c22, c33)
    density = membrane.energy_density(jnp.array(strain))
    assert density >= 4e-4 * sum(e**2 for e in strain)  # the least eigenvalue is >= 1 - 0.999
