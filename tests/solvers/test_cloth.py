"""The cloth in time: conservation laws, the algebra of its steps, and fabrics at the extremes."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    DT,
    FIRST_ROW,
    SHAPE,
    SIZE,
    cloth,
    dense,
    directional_difference,
    energy,
    everywhere,
    flat,
    hanging,
    roll,
    rotation,
)

from r2s._util.units import AIR_DENSITY, GRAVITY
from r2s.environment.scene import Control, along_path
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.mesh import rectangle
from r2s.mesh.surface import vertex_masses
from r2s.scenarios.scenario import rollout
from r2s.scenarios.standard import lifting
from r2s.solvers.implicit.cloth import ImplicitState
from r2s.solvers.implicit.potential import hessian, potential, residual
from r2s.solvers.simulate import simulate

LAW = (300.0, 60.0, 200.0, 80.0)  # [N/m]
STEPS = np.arange(21)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("spectral_radius", [None, 0.6], ids=["BDF2", "alpha"])
def test_free_fall_is_exact(sheet, fabric, spectral_radius):
    # BDF2 differentiates parabolas exactly, given a point of the parabola before the start
    x, v, g = flat(sheet) @ rotation(0.5, 0).T, [0.3, 0.0, 1.0], [0.0, 0.0, -GRAVITY]
    v, g = everywhere(v, sheet), everywhere(g, sheet)
    solver = dataclasses.replace(cloth(sheet), spectral_radius=spectral_radius)
    states = roll(solver, fabric, solver.init(x, v, g), 20)
    x, v, g = (np.asarray(array) for array in (x, v, g))
    exact = np.stack([x + t * v + t**2 / 2 * g for t in STEPS * DT])
    assert states.x == pytest.approx(exact, abs=1e-10)  # tolerance of the solve, 1e-11 m a step


def test_momentum_changes_by_gravity_alone(sheet, fabric):
    random = np.random.default_rng(0)
    x = flat(sheet) + jnp.asarray(random.normal(size=(25, 3)) * 5e-3)
    v = jnp.asarray(random.normal(size=(25, 3)) * 0.3)
    solver = cloth(sheet)
    states = roll(solver, fabric, solver.init(x, v), 20)
    mass = np.asarray(vertex_masses(sheet, fabric.density))
    momentum = np.einsum("v,tvi->ti", mass, states.v)
    assert momentum[:, :2] == pytest.approx(np.tile(momentum[0, :2], (21, 1)), abs=1e-12)
    weight = 0.2 * SIZE**2 * GRAVITY
    assert (momentum[20, 2] - momentum[19, 2]) / DT == pytest.approx(-weight, rel=1e-8)  # 3^-19


def test_damping_does_not_brake_a_rotation(sheet):
    rate = 3.0  # [rad/s], about the vertical
    x = flat(sheet) - jnp.array([[SIZE / 2, SIZE / 2, 0.0]])
    v = jnp.cross(everywhere([0.0, 0.0, rate], sheet), x)
    back = rotation(-rate * DT, 2).T
    solver, spin = cloth(sheet), []
    for damping in (0.0, 10.0):
        fabric = Fabric.make(0.2, (3e3, 6e2, 2e3, 8e2), 2e-5, damping=damping)
        states = roll(solver, fabric, ImplicitState(x, v, x @ back, v @ back), 50)
        place = states.x - states.x.mean(axis=1, keepdims=True)
        mass = np.asarray(vertex_masses(sheet, fabric.density))[:, None]
        moment = np.sum(mass * np.cross(place, states.v), axis=1)[:, 2]
        assert moment[-1] == pytest.approx(moment[0], rel=1e-4)  # BDF2's own damping is 2e-5
        spin.append(moment[-1])
    assert spin[1] == pytest.approx(spin[0], rel=1e-7)


def test_damping_is_proportional_to_stiffness():
    sheet = rectangle((SIZE, SIZE), SHAPE, "quadrilaterals")  # without bending others give way
    # the first standing wave of a free sheet, x = s + a cos(pi s / L), on a grid of 4 cells
    solver, along, peaks = cloth(sheet), sheet.rest[:, 0], []
    wave = jnp.cos(jnp.pi / SIZE * along)
    rate = 8 / SIZE * (0.3 / 0.2) ** 0.5 * np.sin(np.pi / 8)  # [rad/s]
    for damping in (0.0, 0.005):
        fabric = Fabric.make(0.2, (0.3, 0.0, 0.3, 0.1), 0.0, damping=damping)
        start = solver.init(flat(sheet).at[:, 0].add(1e-3 * wave))
        moved = roll(solver, fabric, start, 40).x[:, :, 0] - np.asarray(along)
        peaks.append(np.max((moved * np.asarray(wave)).sum(axis=1)[25:]))
    period = 2 * np.pi / rate
    # 3 %: triangles and vertices share the mass unevenly
    assert peaks[1] / peaks[0] == pytest.approx(np.exp(-(rate**2) * 0.005 / 2 * period), rel=0.03)


def test_a_path_is_linear_between_knots_and_rests_beyond():
    path = jnp.array([[[0.0, 1.0, 2.0]], [[4.0, 1.0, 0.0]]])
    times = jnp.array([-1.0, 0.5, 1.0, 2.0, 9.0])
    found = along_path(times, jnp.array([0.0, 2.0]), path)
    expected = [[0, 1, 2], [1, 1, 1.5], [2, 1, 1], [4, 1, 0], [4, 1, 0]]
    assert np.asarray(found[:, 0]) == pytest.approx(np.array(expected))


@pytest.mark.slow(group="cloth")
def test_air_takes_energy_from_a_swing(sheet, fabric):
    ends = []
    for air in (0.0, AIR_DENSITY):
        solver = cloth(sheet, FIRST_ROW, air=air)
        states = roll(solver, fabric, solver.init(hanging(sheet, np.deg2rad(20))), 100)
        ends.append(energy(sheet, fabric, states.x[-1], states.v[-1]))
    hung = energy(sheet, fabric, hanging(sheet), jnp.zeros((25, 3)))
    assert ends[1] - hung < 0.5 * (ends[0] - hung)


@pytest.fixture(scope="module")
def disturbed():
    """Increments and positions with strain, contact, slip and wind at random, and functions.

    Of cells that do not wrinkle, so that compression makes the exact Hessian indefinite.
    """
    sheet = rectangle((SIZE, SIZE), SHAPE, "quadrilaterals")
    solver = cloth(sheet, FIRST_ROW, table=0.0, air=AIR_DENSITY)
    fabric = Fabric.make(0.2, LAW, 1e-4)

    # both Hessians and the force, in one compilation
    def matrix(at, x, exactness):
        return dense(at.elimination.pattern, hessian(at, x, exactness))

    both = eqx.filter_jit(lambda at, x: (matrix(at, x, 1.0), matrix(at, x, 0.0), residual(at, x)))

    def state(seed):
        noise = jnp.asarray(np.random.default_rng(seed).normal(size=(4, 25, 3))) * 8e-3
        x = flat(sheet, 2e-3) + noise[0]
        start = ImplicitState(x, 20 * noise[1], x + noise[2], 20 * noise[1])
        control = Control(x[:5], jnp.array([2.0, 1.0, -1.0]))
        return solver.potential(fabric, start, control), x + noise[3]

    return state, both


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("seed", range(3))
def test_forces_and_the_hessian_are_derivatives_of_the_energy(disturbed, seed):
    state, both = disturbed
    increment, x = state(seed)
    direction = jax.random.normal(jax.random.key(seed), x.shape)
    matrix, _, force = both(increment, x)
    value = eqx.filter_jit(potential)
    expected = directional_difference(lambda x: value(increment, x), x, direction, 1e-7)
    assert jnp.sum(force * direction) == pytest.approx(float(expected), rel=1e-6)
    difference = directional_difference(lambda x: both(increment, x)[2], x, direction, 1e-7)
    error = jnp.linalg.norm(matrix @ direction.ravel() - difference.ravel())
    assert error < 1e-6 * jnp.linalg.norm(difference)
    assert np.asarray(matrix) == pytest.approx(np.asarray(matrix.T), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_the_convex_hessian_is_positive_definite(disturbed, seed):
    state, both = disturbed
    increment, x = state(seed)
    exact, convex, _ = both(increment, x)
    mass = vertex_masses(increment.mesh, increment.fabric.density)
    inertia = float(jnp.min(mass)) * float(increment.rate) ** 2
    assert jnp.linalg.eigvalsh(convex)[0] >= inertia * (1 - 1e-6)
    assert jnp.linalg.eigvalsh(exact)[0] < 0  # so these states are a test


EXTREME = [  # density, C11, C22, C33, bending
    (0.05, 1e4, 1e4, 1e4, 1e-4),
    (0.05, 10.0, 10.0, 10.0, 1e-7),
    (0.5, 10.0, 10.0, 10.0, 1e-7),
    (0.5, 1e4, 10.0, 10.0, 1e-7),
    (0.05, 1e4, 10.0, 1e4, 1e-4),
    (0.5, 1e4, 1e4, 10.0, 1e-4),
]


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("is_double", [False, True])
def test_extreme_fabrics_stay_finite(is_double):
    with jax.enable_x64(is_double):
        mesh = rectangle((SIZE, SIZE), SHAPE)
        solver = cloth(mesh, FIRST_ROW, table=0.0, air=AIR_DENSITY)
        start = flat(mesh, 1e-3)

        def path(t):
            return start[:5] + jnp.array([[0.0, 0.0, 0.5 * t]])

        for density, c11, c22, c33, bending in EXTREME:
            fabric = Fabric.make(density, (c11, 0.0, c22, c33), bending)
            states = roll(solver, fabric, solver.init(start), 10, path)
            assert states.x.dtype == (np.float64 if is_double else np.float32)
            assert np.all(np.isfinite(states.x))


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("table", [None, 0.0])
def test_every_fabric_of_the_range_of_estimates_has_a_finite_gradient(table):
    """In single precision, in air and on a table."""
    with jax.enable_x64(False):
        mesh = rectangle((0.3, 0.3), (9, 9))
        solver = cloth(mesh, pinned=(0,), table=table, air=1.2, dt=1 / 60)
        along = jnp.minimum(jnp.arange(1, 61) / 60, 1.0)
        path = jnp.stack([0.1 * along, 0.1 * along, 1e-3 + 0.2 * along], axis=-1)
        control, start = Control(path[:, None]), solver.init(flat(mesh, 1e-3))

        @eqx.filter_jit
        @jax.value_and_grad
        def end(fabric):
            return jnp.mean(simulate(solver, fabric, start, control, save_every=3).x[-1] ** 2)

        for c11, c22, bending in itertools.product((3.0, 1e4), (3.0, 1e4), (1e-7, 1e-3)):
            law = (c11, 0.2 * (c11 * c22) ** 0.5, c22, 0.3 * min(c11, c22))
            numbers = np.array(jax.tree.leaves(end(Fabric.make(0.05, law, bending))))
            assert numbers.dtype == np.float32
            assert np.all(np.isfinite(numbers)), (c11, c22, bending)


@pytest.mark.slow(group="cloth")
def test_the_noise_of_the_energy_does_not_stop_newtons_method():
    """The last steps of a soft sheet gain less than the sum of its energies is exact to."""
    space = OrthotropicSpace.make(0.19)
    soft = np.random.default_rng(0).uniform(0, 1, (40, space.dim)) * [1, 1, 1, 1, 0.3, 1, 1]
    lift = lifting().scenario((3, 3))
    fail = eqx.filter_jit(lambda each: jax.lax.map(lambda u: rollout(lift, space(u)).result, each))
    assert not np.any(fail(jnp.asarray(soft)))
