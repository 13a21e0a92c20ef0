"""A sheet of fabric on the grid: conservation, statics, layers, air, and what is refused."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SIZE, everywhere, flat, rotation, two_of
from mpm_bodies import momenta, states, still

import r2s
from r2s._util.units import GRAVITY
from r2s.environment.scene import Control, Scene
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.mesh.surface import vertex_masses
from r2s.scenarios.energy import stored_energy
from r2s.solvers.explicit.sheet import bending_force, membrane_force, membrane_stress
from r2s.solvers.explicit.stability import bending_frequency, membrane_frequency
from r2s.solvers.mpm import Grid, MPMCloth
from r2s.solvers.mpm.sheet import Transverse, stable_step, unit_normal
from r2s.solvers.results import Result

SPACING = 0.05


def solver_of(mesh, fabric, pinned=(), table=None, air=None, dt=5e-4, room=0.25, **options):
    """A solver for a sheet with room [m] around it."""
    high = float(jnp.max(mesh.rest)) + room
    grid = Grid.covering((-room, -room, -room), (high, high, room), SPACING)
    if table is not None:
        grid = Grid.covering((-room, -room, table), (high, high, table + room), SPACING)
    return MPMCloth(Scene(mesh, tuple(pinned), table, air), dt, fabric, grid, **options)


@pytest.fixture(scope="module")
def elastic(fabric):
    """The fabric without damping."""
    return eqx.tree_at(lambda f: f.damping, fabric, jnp.zeros((), float))


@pytest.mark.slow(group="mpm")
def test_momenta_are_kept_to_rounding(sheet, elastic):
    solver = solver_of(sheet, elastic)
    solver = eqx.tree_at(lambda s: s.background.gravity, solver, jnp.zeros((), float))
    x = flat(sheet)
    noise = 0.05 * jax.random.normal(jax.random.key(0), x.shape)
    start = solver.init(x, noise + 3 * (x - SIZE / 2)[:, jnp.array([2, 0, 1])])
    # pressed and tilted, so that what is between the layers acts too
    pressed = start.d * 0.3 + 0.1 * jax.random.normal(jax.random.key(1), start.d.shape)
    start = dataclasses.replace(start, d=pressed)
    moved = states(solver, elastic, start, still(60))
    linear, angular = momenta(moved, vertex_masses(sheet, elastic.density), SPACING)
    assert linear == pytest.approx(np.broadcast_to(linear[0], linear.shape), abs=1e-14)
    assert angular == pytest.approx(np.broadcast_to(angular[0], angular.shape), abs=1e-14)
    assert np.max(np.abs(angular[0])) > 1e-5


@pytest.mark.slow(group="mpm")
def test_the_forces_are_those_of_the_energy(sheet, fabric):
    x = flat(sheet) + 0.01 * jax.random.normal(jax.random.key(0), (25, 3))
    for bending in (fabric.bending, HingeBending(jnp.asarray(2e-5))):
        of = eqx.tree_at(lambda f: f.bending, fabric, bending)
        membrane = membrane_force(sheet, x, membrane_stress(sheet, of, x))
        force = eqx.filter_jit(lambda v, of=of: bending_force(sheet, of, x, v))
        found = force(jnp.zeros_like(x))
        expected = -jax.grad(stored_energy, argnums=2)(sheet, of, x)
        assert membrane + found == pytest.approx(np.asarray(expected), rel=1e-9, abs=1e-12)
        folding = x * jnp.array([[0.0, 0.0, 1.0]])
        braking = force(folding) - found
        assert jnp.sum(braking * folding) < 0
        turned = everywhere([0.1, 0.2, 0.3], sheet) + jnp.cross(jnp.array([[1.0, 2.0, 3.0]]), x)
        rigid = force(turned)
        assert rigid == pytest.approx(np.asarray(found), rel=1e-9, abs=1e-12)


@pytest.mark.slow(group="mpm")
def test_the_frequencies_are_bounds_of_those_of_the_matrices(sheet, fabric):
    mass = jnp.repeat(vertex_masses(sheet, fabric.density), 3)
    none = eqx.tree_at(lambda f: f.bending, fabric, HingeBending(jnp.zeros((), float)))
    soft = jax.tree.map(lambda c: 1e-9 * c, fabric.membrane)
    bent = eqx.tree_at(lambda f: f.membrane, fabric, soft)
    for of, bound in ((none, membrane_frequency), (bent, bending_frequency)):
        stiffness = jax.hessian(stored_energy, argnums=2)(sheet, of, flat(sheet))
        matrix = stiffness.reshape(75, 75) / jnp.sqrt(mass[:, None] * mass[None])
        largest = float(jnp.linalg.eigvalsh(matrix)[-1])
        assert largest < float(eqx.filter_jit(bound)(sheet, of)) < 6 * largest


@pytest.mark.slow(group="mpm")
def test_a_hanging_sheet_stretches_as_it_should():
    """Force per width P = C11 (s^2 - 1) s / 2 at a stretch s carries what hangs below."""
    shape, length = (9, 5), 0.4
    mesh = r2s.rectangle((length, 0.2), shape)
    fabric = Fabric.make(0.3, (12.0, 0.0, 12.0, 6.0), 1e-5, damping=2e-3, mass_damping=6.0)
    grid = Grid.covering((-0.1, -0.1, -0.7), (0.1, 0.3, 0.1), SPACING)
    solver = MPMCloth(Scene(mesh, range(5), air=None), 1.2e-3, fabric, grid)
    x = jnp.stack([0 * mesh.rest[:, 0], mesh.rest[:, 1], -mesh.rest[:, 0]], axis=1)
    control = Control(jnp.broadcast_to(x[:5], (1800, 5, 3)))
    found = eqx.filter_jit(r2s.simulate)(solver, fabric, solver.init(x), control, save_every=1800)
    found = found.x[-1]
    where = np.linspace(0, length, 2001)
    stretch = np.ones_like(where)
    for _ in range(50):  # Newton
        pull = 12.0 * (stretch**2 - 1) * stretch / 2 - 0.3 * GRAVITY * (length - where)
        stretch -= pull / (12.0 * (3 * stretch**2 - 1) / 2)
    hung = np.concatenate([[0], np.cumsum((stretch[1:] + stretch[:-1]) / 2 * np.diff(where))])
    expected = np.interp(np.asarray(mesh.rest[:, 0]), where, hung)
    extension = hung[-1] - length
    assert extension > 0.015
    rows = -np.asarray(found)[:, 2].reshape(shape)
    assert rows.mean(axis=1) == pytest.approx(expected.reshape(shape)[:, 0], abs=0.01 * extension)
    assert rows.reshape(-1) == pytest.approx(expected, abs=0.025 * extension)


def _layers():
    return Transverse(*(jnp.asarray(value) for value in (20.0, 10.0, 0.9)))


def test_layers_press_and_do_not_pull():
    corners = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [0.0, 1.0, 0.1]])
    normal = unit_normal(corners)
    law, friction = _layers(), jnp.asarray(0.5)
    apart = law.return_mapping(corners, 1.3 * normal + jnp.array([0.1, 0.0, 0.0]), friction)
    assert apart == pytest.approx(np.asarray(normal), abs=1e-6)  # it forgets
    force, stress = law.stress(corners, apart)
    assert force == pytest.approx(0, abs=1e-4) and stress == pytest.approx(0, abs=1e-4)
    pressed = law.return_mapping(corners, 0.8 * normal, friction)
    assert pressed == pytest.approx(np.asarray(0.8 * normal), abs=1e-12)
    pressure = normal @ law.stress(corners, pressed)[1] @ normal
    assert pressure == pytest.approx(-20.0 * 0.1**2 * 0.8)


def test_pressed_layers_slide_when_coulomb_lets_them():
    corners = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    law, friction = _layers(), jnp.asarray(0.5)
    limit = 0.5 * 20.0 * 0.1**2 / 10.0  # friction x pressure / shear stiffness
    for tilt in (0.5 * limit, 3 * limit):
        found = law.return_mapping(corners, jnp.array([tilt, 0.0, 0.8]), friction)
        assert found == pytest.approx([min(tilt, limit), 0, 0.8], abs=1e-9)


def test_stresses_between_layers_exert_no_torque():
    corners = jax.random.normal(jax.random.key(0), (3, 3))
    direction = 0.7 * unit_normal(corners) + jnp.array([0.1, -0.2, 0.1])
    law = _layers()
    force, stress = law.stress(corners, direction)
    torque = jnp.sum(jnp.cross(corners, force), axis=0)
    # what the stress does at the nodes: sum d x (stress d), minus its axial vector
    axial = jnp.stack([stress[2, 1] - stress[1, 2], stress[0, 2] - stress[2, 0]])
    axial = jnp.append(axial, stress[1, 0] - stress[0, 1])
    assert torque - axial == pytest.approx(0, abs=1e-12)
    assert jnp.sum(force, axis=0) == pytest.approx(0, abs=1e-13)
    turn = rotation(0.7, 0) @ rotation(0.4, 2)
    assert law.energy(corners @ turn.T, turn @ direction) == pytest.approx(
        float(law.energy(corners, direction)), rel=1e-12
    )


@pytest.fixture(scope="module")
def pair(sheet, fabric):
    """Two sheets, and a solver for them over a table."""
    mesh, fabric = two_of(sheet), eqx.tree_at(lambda f: f.damping, fabric, jnp.asarray(2e-4, float))
    grid = Grid.covering((-0.15, -0.15, 0.0), (0.35, 0.35, 0.3), SPACING)
    scene = Scene(mesh, table=0.0, air=None)
    return MPMCloth(scene, 5e-4, fabric, grid), fabric


def test_pressed_layers_push_each_other_away(pair, sheet):
    solver, fabric = pair
    start = solver.init(jnp.concatenate([flat(sheet, 0.1), flat(sheet, 0.1 + 0.3 * SPACING)]))
    gaps = []
    for pressed in (1.0, 0.4):  # they press below 0.5
        moved = states(solver, fabric, dataclasses.replace(start, d=pressed * start.d), still(20))
        heights = np.asarray(moved.x)[-1, :, 2].reshape(2, 25)
        gaps.append(np.mean(heights[1] - heights[0]))
    assert gaps[0] == pytest.approx(0.3 * SPACING, rel=1e-3)
    assert gaps[1] > gaps[0] + 1e-4


@pytest.mark.slow(group="mpm")
def test_a_sheet_that_falls_on_another_stays_on_it(pair, sheet):
    solver, fabric = pair
    x = jnp.concatenate([flat(sheet, 2e-3), flat(sheet, 0.12)])
    moved = states(solver, fabric, solver.init(x), still(1500))
    low, high = np.asarray(moved.x)[:, :25, 2], np.asarray(moved.x)[:, 25:, 2]
    assert np.min(low) >= 0
    assert np.min(high - low) > 0.2 * SPACING
    assert np.max(np.abs(np.asarray(moved.v)[-1])) < 0.05  # at rest
    assert 0.7 * SPACING < np.mean(high[-1] - low[-1]) < 1.3 * SPACING


def test_wind_gives_the_momentum_of_its_drag(sheet, elastic):
    solver = solver_of(sheet, elastic, air=1.2)
    solver = eqx.tree_at(lambda s: s.background.gravity, solver, jnp.zeros((), float))
    wind = jnp.broadcast_to(jnp.array([0.0, 0.0, 3.0]), (60, 3))
    controls = dataclasses.replace(still(60), wind=wind)
    moved = states(solver, elastic, solver.init(flat(sheet)), controls)
    gained = np.sum(np.asarray(vertex_masses(sheet, elastic.density))[:, None] * moved.v[0], axis=0)
    expected = solver.dt * 1.2 * 2 / 2 * SIZE**2 * 3.0**2
    assert gained == pytest.approx([0, 0, expected], abs=1e-14)


def test_what_cannot_work_is_refused(sheet, elastic):
    limit = float(stable_step(sheet, SPACING, elastic))
    with pytest.raises(ValueError, match=f"limited by .* to {limit:.4g} s, got dt = 0.1 s"):
        solver_of(sheet, elastic, dt=0.1)
    damped = eqx.tree_at(lambda f: f.damping, elastic, jnp.asarray(0.01, float))
    with pytest.raises(ValueError, match="less damping"):
        solver_of(sheet, damped)
    solver_of(sheet, damped, membrane_damping=1e-4)
    with pytest.raises(ValueError, match="edges may be"):
        solver_of(r2s.rectangle((0.4, 0.4), (3, 3)), elastic)
    with pytest.raises(ValueError, match="outside the grid"):
        solver_of(sheet, elastic).init(flat(sheet, 1.0))


@pytest.mark.slow(group="mpm")
def test_a_sheet_that_is_carried_out_of_the_grid_ends_the_run(sheet, elastic):
    """Also where every vertex is held, and its place known all the time."""
    solver = solver_of(sheet, elastic, pinned=tuple(range(25)))
    x, height = flat(sheet), jnp.linspace(0, 0.5, 60)[:, None, None]
    path = x[None] + height * jnp.array([[[0.0, 0.0, 1.0]]])
    moved = r2s.simulate(solver, elastic, solver.init(x), Control(path))
    assert moved.result == Result.GRID and not moved.ok[-1]
    grid = solver.background.grid
    top = float(grid.lower[2]) + (grid.shape[2] - 1.5) * grid.spacing
    first = int(jnp.argmax(path[:, 0, 2] > top))
    assert float(moved.failed_at) == pytest.approx((first + 1) * solver.dt)
    np.testing.assert_array_equal(moved.x[:first], path[:first])  # as the grippers are
