"""Table and air: Coulomb friction and its smoothing, terminal velocity, wind, mass damping."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DT, cloth, directional_difference, everywhere, few, flat, roll
from hypothesis import given
from hypothesis import strategies as st

from r2s._util.units import AIR_DENSITY, GRAVITY
from r2s.environment.air import STILL, Air, Fan
from r2s.environment.contact import (
    PRESSURE_STIFFNESS,
    SLIP_SPEED,
    Table,
    friction_dissipation,
    normal_potential,
    pressure,
)
from r2s.materials.fabric import Fabric

REST_DEPTH = (0.2 * GRAVITY / PRESSURE_STIFFNESS) ** 0.5  # [m], where pressure carries 0.2 kg/m^2


@pytest.fixture(scope="module")
def lying(sheet, fabric):
    """A solver with a table, and where a sheet lies on it."""
    return cloth(sheet, table=0.0), flat(sheet, float(fabric.thickness) - REST_DEPTH)


def pulled(lying, fabric, acceleration, count):
    """Speeds of a sheet at rest on the table that a uniform force pulls along."""
    solver, start = lying
    state = solver.init(start)
    speeds = []
    for _ in range(count):
        # the step's inertia starts from (4 v - v_before) / 3, so this adds dt times 2/3 of it
        push = everywhere([2 * acceleration * DT, 0.0, 0.0], solver.scene.mesh)
        state = eqx.tree_at(lambda state: state.v_before, state, state.v_before - push)
        last = roll(solver, fabric, state, 1)
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), last)
        speeds.append(float(jnp.mean(state.v[:, 0])))
    return speeds


def test_a_pull_below_the_limit_only_creeps(fabric, lying):
    share = 0.6  # of the limit
    speed = pulled(lying, fabric, share * 0.5 * GRAVITY, 15)[-1]
    assert speed < SLIP_SPEED
    assert speed == pytest.approx(SLIP_SPEED * share / (1 - share**2) ** 0.5, rel=1e-3)


def test_a_pull_above_the_limit_accelerates_by_the_rest(fabric, lying):
    speeds = pulled(lying, fabric, 1.5 * 0.5 * GRAVITY, 9)
    acceleration = (speeds[-1] - speeds[4]) / (4 * DT)
    assert acceleration == pytest.approx(0.5 * 0.5 * GRAVITY, rel=0.01)  # start-up's 3^-4


@given(st.floats(-1e-3, 2e-3), st.floats(1e-4, 5e-3))
@few
def test_pressure_begins_at_the_thickness(height, thickness):
    table = Table.make(0.0)
    position = jnp.array([0.0, 0.0, height])
    force = -jax.grad(lambda x: normal_potential(table.depth(x, jnp.array(thickness))))(position)
    expected = PRESSURE_STIFFNESS * max(thickness - height, 0) ** 2
    assert force[2] == pytest.approx(expected, rel=1e-9)
    assert force[2] == pytest.approx(float(pressure(table.depth(position, jnp.array(thickness)))))
    assert force[0] == force[1] == 0


@given(st.tuples(*[st.floats(-1, 1)] * 2), st.floats(0, 1))
@few
def test_friction_is_within_its_cone_and_against_the_slip(velocity, limit):
    velocity = jnp.array(velocity)
    force = -jax.grad(friction_dissipation, argnums=1)(jnp.array(limit), velocity)
    assert jnp.linalg.norm(force) <= limit * (1 + 1e-12)
    assert force @ velocity <= 0


def test_a_falling_sheet_reaches_its_terminal_velocity(sheet, fabric):
    solver = cloth(sheet, air=AIR_DENSITY)
    states = roll(solver, fabric, solver.init(flat(sheet)), 120)
    expected = -((2 * 0.2 * GRAVITY / (AIR_DENSITY * 2)) ** 0.5)
    assert states.v[-1, :, 2] == pytest.approx(expected, rel=0.01)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(0.1, 1)] * 3))
@few
def test_drag_is_the_pressure_of_the_normal_flow(velocity, normal):
    velocity, normal = jnp.array(velocity), jnp.array(normal)
    air = Air.make(1.3, 1.7, 0.0)
    area = float(jnp.linalg.norm(normal))
    flow = float(velocity @ normal) / area
    expected = -1.3 * 1.7 / 2 * abs(flow) * flow * np.asarray(normal)
    found = -jax.grad(air.dissipation)(velocity, normal)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)

    def potential(velocity):
        return air.dissipation(velocity, normal)

    change = directional_difference(potential, velocity, jnp.ones(3), 1e-5)
    assert -change == pytest.approx(float(np.sum(expected)), rel=1e-6, abs=1e-8)


def test_a_fan_blows_half_at_its_radius_and_less_outside():
    fan = Fan(jnp.zeros(3), jnp.array([2.0, 0.0, 0.0]), jnp.asarray(0.3), jnp.asarray(0.2))
    far = 0.7  # along the axis, which changes nothing
    places = jnp.array([[far, 0.0, 0.0], [far, 0.2, 0.0], [far, 0.0, 0.3], [0.0, 0.0, 0.4]])
    blown = fan(places)
    assert blown[1] == pytest.approx(0.88, abs=0.02) and blown[3] == pytest.approx(0.12, abs=0.02)
    assert blown[0] > 0.99 and blown[2] == pytest.approx(0.5, abs=0.03)
    assert jax.grad(lambda x: fan(x)[0])(places[:1]) == pytest.approx(0)  # on the axis, not NaN


@given(st.tuples(*[st.floats(-3, 3)] * 2), st.floats(-3, 3))
@few
def test_flow_along_a_face_pulls_it_along(flow, normal_flow):
    air = Air.make(1.3, 0.0, 0.4)
    area_normal = jnp.array([0.0, 0.0, 0.02])
    force = -jax.grad(air.dissipation)(-jnp.array([*flow, normal_flow]), area_normal)
    expected = 1.3 * 0.4 / 2 * 0.02 * np.hypot(*flow) * np.array([*flow, 0.0])
    # where the flow is slow its friction fades to linear
    assert force == pytest.approx(expected, rel=1e-9, abs=1.3 * 0.4 / 2 * 0.02 * STILL**2)


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
