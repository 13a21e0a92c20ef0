"""Tables of measured stiffness: what is published where, smoothness, what a step makes of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import FIRST_ROW, SIZE, cloth, few, flat, roll
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from r2s._util.units import GRAVITY
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import MembraneLaw, OrthotropicMembrane
from r2s.materials.tables import HINGE_FACTOR, TableBending, TableMembrane

STRETCHING = jnp.array(  # [N/m]; numbers of no fabric, which tell the rows apart
    [
        [100.0, 20.0, 50.0, 30.0],
        [210.0, 31.0, 71.0, 41.0],
        [230.0, 33.0, 74.0, 44.0],
        [260.0, 36.0, 78.0, 48.0],
        [300.0, 40.0, 83.0, 53.0],
        [350.0, 45.0, 89.0, 59.0],
    ]
)
BENDING = 1e-5 * jnp.array(  # [N m]
    [[1.0, 1.1, 1.3, 1.6, 2.0], [3.0, 3.2, 3.5, 3.9, 4.4], [6.0, 6.3, 6.7, 7.2, 7.8]]
)
LARGE = 7 / 6  # the stretch of rows 1 to 5
ROW_DIRECTIONS = jnp.deg2rad(jnp.array([0.0, 22.5, 45.0, 67.5, 90.0]))
MEMBRANE = TableMembrane(STRETCHING)


def strain_of(stretch, direction, other=1.0):
    """Green strain (E11, E22, 2 E12) with a principal stretch along a direction [rad]."""
    high, low = (stretch**2 - 1) / 2, (other**2 - 1) / 2
    c, s = jnp.cos(direction), jnp.sin(direction)
    return jnp.stack([c**2 * high + s**2 * low, s**2 * high + c**2 * low, 2 * s * c * (high - low)])


def numbers(law):
    """C11, C12, C22, C33 [N/m] of a law, with C33 as published."""
    return jnp.stack([law.c11, law.c12, law.c22, 2 * law.c33])


def _look(law, strain):
    return numbers(law.at(strain))


look = jax.jit(_look)
slope = jax.jit(jax.jacfwd(_look, argnums=1))
bend = jax.jit(lambda law, direction, curvature: law.at(direction, curvature).stiffness)


def test_the_rows_are_the_published_ones_and_directions_between_them_linear():
    strains = [jnp.zeros(3), *(strain_of(LARGE, direction) for direction in ROW_DIRECTIONS)]
    for strain, row in zip(strains, STRETCHING, strict=True):
        # the blur of the direction, which falls with the square of the strain
        assert look(MEMBRANE, strain) == pytest.approx(np.asarray(row), rel=1e-4)
    between = 0.75 * STRETCHING[3] + 0.25 * STRETCHING[4]
    strain = strain_of(LARGE, jnp.deg2rad(22.5 * 2.25))
    assert look(MEMBRANE, strain) == pytest.approx(np.asarray(between), rel=1e-4)


def test_stiffness_is_linear_in_the_stretch_and_constant_beyond_the_table():
    for extension, weight in ((-0.1, 0), (1 / 24, 1 / 4), (1 / 8, 3 / 4), (1 / 6, 1), (0.5, 1)):
        narrow = min(1.0, 1 + extension)  # the smaller stretch does not count
        found = look(MEMBRANE, strain_of(1 + extension, 0.0, 0.8 * narrow))
        expected = STRETCHING[0] + weight * (STRETCHING[1] - STRETCHING[0])
        assert found == pytest.approx(np.asarray(expected), rel=1e-3)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-160, 1e-30, 1e-12, 1e-8, 1e-3, 0.3, -0.2, -0.5])
def test_stiffness_and_its_derivatives_are_finite(size):
    for direction in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1e-9], [1, -1, 0]):
        strain = size * jnp.array(direction, float)
        assert jnp.all(jnp.isfinite(look(MEMBRANE, strain)))
        assert jnp.all(jnp.isfinite(slope(MEMBRANE, strain)))


def test_a_table_of_equal_rows_is_a_constant_law():
    constant = OrthotropicMembrane(*(jnp.asarray(c) for c in (300.0, -40.0, 200.0, 80.0)))
    law = TableMembrane(jnp.tile(numbers(constant), (6, 1)))
    assert isinstance(law, MembraneLaw)
    for strain in ([0.0, 0.0, 0.0], [0.1, -0.02, 0.03], [0.2, 0.2, 0.0]):
        assert jnp.all(look(law, jnp.array(strain)) == numbers(constant))
        energy = law.energy_density(jnp.array(strain))
        assert energy == constant.energy_density(jnp.array(strain))


@given(st.lists(st.floats(-100, 400), min_size=24, max_size=24), *[st.floats(-0.4, 0.4)] * 3)
@few
def test_no_measured_number_makes_a_negative_stiffness(entries, e11, e22, shear):
    law = TableMembrane(jnp.array(entries).reshape(6, 4))
    c11, c12, c22, c33 = look(law, jnp.array([e11, e22, shear]))
    assert min(c11, c22, c33) >= 0
    assert c12**2 <= c11 * c22 * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("row, direction", [(0, np.pi / 2), (1, np.pi / 4), (2, 0.0)])
@pytest.mark.parametrize("column", range(5))
def test_bending_entries_are_the_published_ones(row, direction, column):
    # row 0 is of edges along the warp, which bend the weft
    for sign in (1.0, -1.0):
        found = bend(TableBending(BENDING), jnp.array(direction), jnp.array(sign * 10.0 * column))
        assert HINGE_FACTOR * found == pytest.approx(float(BENDING[row, column]), rel=1e-12)


def test_bending_is_linear_between_its_entries_and_constant_beyond():
    law = TableBending(BENDING)
    found = bend(law, jnp.array(3 * np.pi / 8), jnp.array(-25.0))
    expected = (BENDING[0, 2] + BENDING[0, 3] + BENDING[1, 2] + BENDING[1, 3]) / 4
    assert HINGE_FACTOR * found == pytest.approx(float(expected), rel=1e-12)
    assert bend(law, jnp.array(0.0), jnp.array(1e3)) == bend(law, jnp.array(0.0), jnp.array(40.0))


def test_the_hinge_has_the_force_of_the_published_stiffness():
    # k l^2 / (4 A) theta, of the energy A B (theta l / A)^2 / 2
    stiffness, length, area, angle = 3e-5, 0.12, 0.015, 0.4
    law = TableBending(jnp.full((3, 5), stiffness)).at(jnp.array(0.3), jnp.array(0.0))

    def energy(angle):
        return area * law.energy_density(angle * length / area)

    force = jax.grad(energy)(jnp.array(angle))
    assert force == pytest.approx(stiffness * length**2 / (4 * area) * angle, rel=1e-12)


def tabled(membrane, bending):
    fabric = Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5, damping=0.05)
    return dataclasses.replace(fabric, membrane=membrane, bending=bending)


@pytest.mark.slow(group="cloth")
def test_a_sheet_hangs_by_the_stiffness_of_its_strain(sheet):
    # by the first row, so stretched along the warp; without C12 its width does not matter
    membrane = TableMembrane(0.1 * STRETCHING.at[:, 1].set(0.0))
    solver = cloth(sheet, FIRST_ROW)
    start = flat(sheet)[:, jnp.array([2, 1, 0])] * jnp.array([[1.0, 1.0, -1.0]])
    x = roll(solver, tabled(membrane, TableBending(BENDING)), solver.init(start), 400).x[-1]
    height = x[:, 2].reshape(5, 5).mean(axis=1)

    def surplus(stretch, tension, is_table):
        law = membrane.at(strain_of(jnp.array(stretch if is_table else 1.0), 0.0))
        return float(law.c11) * stretch * (stretch**2 - 1) / 2 - tension  # [N/m]

    def extension(is_table):
        cell = SIZE / 4
        tensions = 0.2 * GRAVITY * (SIZE - cell * (np.arange(4) + 0.5))
        stretches = np.array([brentq(surplus, 1, 1.5, (t, is_table)) for t in tensions])
        return cell * np.sum(stretches - 1)

    assert height[0] - height[-1] - SIZE == pytest.approx(extension(True), rel=0.01)
    assert extension(False) > 1.1 * extension(True)  # so the table makes a difference
