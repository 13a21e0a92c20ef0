"""Laws against what they stand for: springs, orthotropic and isotropic sheets, damping, air."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DT, SHAPE, SIZE, cloth, everywhere, flat, roll, rotation, stored_energy
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s._util.units import GRAVITY
from r2s.environment.air import STILL, Air
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import SpringMembrane
from r2s.mesh.mesh import Mesh, rectangle
from r2s.mesh.surface import strains

CELL = SIZE / (SHAPE[0] - 1)  # side of the sheet's squares, [m]
few = settings(max_examples=25, deadline=None)


def law(kind, *parameters):
    return kind(*(jnp.asarray(parameter, float) for parameter in parameters))


@eqx.filter_jit
def membrane_energy(mesh, membrane, x):
    """Energy [J] in the strains alone."""
    return jnp.sum(mesh.samples.areas.ravel() * jax.vmap(membrane.energy_density)(strains(mesh, x)))


def spring_energy(x, first, second, constant, length):
    """Energy [J] of springs [N/m] between vertices, of a rest length [m]."""
    stretched = np.linalg.norm(x[second] - x[first], axis=-1)
    return np.sum(constant / 2 * (stretched - length) ** 2)


INDEX = np.arange(25).reshape(SHAPE)


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


forces = jax.jit(jax.grad(stored_energy, argnums=2))


@pytest.mark.parametrize("degrees", [30, -70])
def test_uniaxial_stretch_across_the_yarns_is_exact(degrees, sheet, fabric):
    angle, stretch = np.deg2rad(degrees), 1.1
    rest = sheet.rest @ rotation(-angle, 2)[:2, :2].T  # the warp at this angle to the stretch
    mesh = Mesh.make(np.asarray(rest), np.asarray(sheet.faces))
    x = (flat(sheet) * jnp.array([[stretch, 1.0, 1.0]])) @ rotation(0.7, 0).T
    green, c, s = (stretch**2 - 1) / 2, np.cos(angle), np.sin(angle)
    e11, e22, shear = green * c**2, green * s**2, -2 * green * c * s
    density = (300 * e11**2 + 2 * 60 * e11 * e22 + 200 * e22**2 + 80 * shear**2) / 2
    found = np.asarray(strains(mesh, x))
    assert found == pytest.approx(np.tile([e11, e22, shear], (32, 1)), abs=1e-13)
    assert stored_energy(mesh, fabric, x) == pytest.approx(SIZE**2 * density, rel=1e-12)
    force = forces(mesh, fabric, x)
    assert jnp.max(jnp.abs(force[INDEX[1:-1, 1:-1].ravel()])) < 1e-12 * jnp.max(jnp.abs(force))


def test_mass_damping_brakes_a_fall(sheet):
    rate = 3.0  # [1/s]
    fabric = Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5, mass_damping=rate)
    solver = cloth(sheet)
    start = solver.init(flat(sheet), acceleration=everywhere([0.0, 0.0, -GRAVITY], sheet))
    velocity = roll(solver, fabric, start, 120).v[1:, :, 2]
    time = DT * np.arange(1, 121)
    expected = -GRAVITY / rate * (1 - np.exp(-rate * time))
    assert velocity == pytest.approx(np.tile(expected[:, None], 25), rel=0.01)
    assert velocity[-1] == pytest.approx(-GRAVITY / rate, rel=0.03)  # exp(-3.6)


@given(st.tuples(*[st.floats(-3, 3)] * 2), st.floats(-3, 3))
@few
def test_flow_along_a_face_pulls_it_along(flow, normal_flow):
    air = Air.make(1.3, 0.0, 0.4)
    area_normal = jnp.array([0.0, 0.0, 0.02])
    force = -jax.grad(air.dissipation)(-jnp.array([*flow, normal_flow]), area_normal)
    expected = 1.3 * 0.4 / 2 * 0.02 * np.hypot(*flow) * np.array([*flow, 0.0])
    # where the flow is slow its friction fades to linear
    assert force == pytest.approx(expected, rel=1e-9, abs=1.3 * 0.4 / 2 * 0.02 * STILL**2)
