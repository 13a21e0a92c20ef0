"""A solid block: conservation, waves, contact, grippers, 2-D against 3-D, and what is refused."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpm_bodies import box, lattice, momenta, small_block, solid, states, still

import r2s
from r2s._util.units import GRAVITY
from r2s.environment.contact import Table
from r2s.environment.scene import Control
from r2s.materials.solid import FixedCorotated, LinearSolid, NeoHookean
from r2s.solvers.mpm import Background, Block, Grid
from r2s.solvers.mpm.block import stable_step
from r2s.solvers.results import Result

STEPS = still(60, 2)


def spinning(x, rate=3.0):
    """Velocities [m/s] of a body that turns and drifts."""
    axes = x.shape[1]
    matrix = jnp.zeros((axes, axes)).at[0, 1].set(-rate).at[1, 0].set(rate)
    return (x - jnp.mean(x, axis=0, keepdims=True)) @ matrix.T + 0.1


@pytest.mark.parametrize("axes", [2, pytest.param(3, marks=pytest.mark.slow(group="mpm"))])
def test_momenta_are_kept_to_rounding(axes):
    solver, material, x = small_block(axes, gravity=0.0)
    # stretched, so that it pulsates
    middle = jnp.mean(x, axis=0, keepdims=True)
    start = solver.init(middle + 1.05 * (x - middle), spinning(x))
    start = dataclasses.replace(start, F=1.05 * start.F)
    moved = states(solver, material, start, still(60, axes))
    linear, angular = momenta(moved, material.density * solver.volume, 1 / 8)
    assert linear == pytest.approx(np.broadcast_to(linear[0], linear.shape), rel=1e-11)
    assert angular == pytest.approx(
        np.broadcast_to(angular[0], angular.shape), rel=1e-10, abs=1e-12
    )
    assert np.ptp(np.linalg.norm(moved.v, axis=2)[:, 0]) > 0.05  # it did pulsate


def test_free_fall_is_exact():
    solver, material, x = small_block(2)
    moved = states(solver, material, solver.init(x), STEPS)
    count = np.arange(1, 61)[:, None]
    fallen = GRAVITY * solver.dt**2 * count * (count + 1) / 2  # of symplectic Euler
    fallen = np.stack([0 * fallen, fallen], axis=2)
    assert np.asarray(moved.x) == pytest.approx(np.asarray(x)[None] - fallen, abs=1e-13)
    assert np.asarray(moved.F) == pytest.approx(
        np.broadcast_to(np.eye(2), moved.F.shape), abs=1e-12
    )


SLOW_LAWS = [
    pytest.param(law, marks=pytest.mark.slow(group="mpm")) for law in (NeoHookean, LinearSolid)
]


@pytest.mark.parametrize("law", [FixedCorotated, *SLOW_LAWS])
def test_a_bar_rings_at_the_speed_of_its_waves(law):
    """Fundamental longitudinal period 2 L / sqrt(E / rho) of a free bar."""
    young, density, length, spacing = 1e4, 1e3, 1.0, 1 / 32
    grid = Grid.covering((0.0, 0.0), (1.2, 0.3), spacing)
    x, volume = lattice((0.1, 0.1), (1.1, 0.1 + 2 * spacing), spacing / 2)
    material = solid(young, 0.0, density, law)
    background = Background(grid, gravity=0.0)
    period = 2 * length / math.sqrt(young / density)
    solver = Block.make(background, volume, material, period / 512)
    shape = jnp.cos(math.pi * (x[:, 0] - 0.1) / length)
    start = solver.init(x, 1e-3 * jnp.stack([shape, 0 * shape], axis=1))
    moved = states(solver, material, start, still(512, 2))
    amplitude = np.asarray(moved.v)[:, :, 0] @ np.asarray(shape)
    crossings = np.flatnonzero(np.diff(np.sign(amplitude)))
    fraction = amplitude[crossings] / (amplitude[crossings] - amplitude[crossings + 1])
    times = (crossings + 1 + fraction) / 512  # in periods: 1/4 and 3/4
    assert len(times) == 2
    assert 2 * (times[1] - times[0]) == pytest.approx(1, rel=0.03)


@pytest.mark.slow(group="mpm")
def test_three_dimensions_repeat_two():
    """A body without Poisson effect that is the same all along y moves as in the plane."""
    spacing = 1 / 8
    flat, deep = (
        Background(Grid.covering((0.0,) * axes, (1.0,) * axes, spacing), Table.make(0.3))
        for axes in (2, 3)
    )
    material = solid(5e3, 0.0, friction=0.4)
    x, volume = lattice((0.25, 0.375), (0.625, 0.625), 1 / 16)
    solver = Block.make(flat, volume, material, 1e-3)
    expected = states(solver, material, solver.init(x, jnp.full(x.shape, 0.3)), still(250, 2))
    assert np.min(expected.x[..., 1]) < 0.33  # it reached the table
    shared = jnp.repeat(x, 6, axis=0)
    along = jnp.tile(0.3 + jnp.arange(6) / 16, x.shape[0])
    volume = jnp.repeat(volume / 16, 6)
    x3 = jnp.stack([shared[:, 0], along, shared[:, 1]], axis=1)
    v3 = jnp.broadcast_to(jnp.array([[0.3, 0.0, 0.3]]), x3.shape)
    solver3 = Block.make(deep, volume, material, 1e-3)
    found = states(solver3, material, solver3.init(x3, v3), still(250, 3))
    planar = np.asarray(found.x)[:, ::6][..., [0, 2]]
    assert planar == pytest.approx(np.asarray(expected.x), abs=1e-9)
    assert np.ptp(np.asarray(found.x)[..., 1], axis=0) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_block_on_the_table_slides_or_slows(friction):
    background = box(2, 8, table=Table.make(0.25))
    x, volume = lattice((0.3, 0.25), (0.55, 0.5), 1 / 16)
    material = solid(2e5, 0.2, friction=friction, damping=1e-3)
    solver = Block.make(background, volume, material, 1e-3)
    start = solver.init(x, jnp.broadcast_to(jnp.array([[0.5, 0.0]]), x.shape))
    moved = states(solver, material, start, still(100, 2))
    assert np.min(moved.x[..., 1]) >= 0.25
    assert np.max(np.asarray(moved.x)[-1, :, 1]) == pytest.approx(0.5 - 1 / 32, abs=0.02)
    gone = np.mean(np.asarray(moved.x)[-1, :, 0] - np.asarray(x)[:, 0])
    expected = 0.5 * 0.1 - friction * GRAVITY * 0.1**2 / 2  # of a rigid one
    assert gone == pytest.approx(expected, abs=2e-3)


@pytest.mark.slow(group="mpm")
def test_a_cantilever_bends_as_a_beam_does():
    """Tip deflection of Timoshenko's beam under its weight, no Poisson effect."""
    errors = [_tip_error(cells) for cells in (4, 8, 16)]  # across its height
    assert errors == sorted(errors, reverse=True)
    assert errors[0] < 0.06 and errors[-1] < 0.015  # 0.045, 0.021 and 0.010 were measured


def _tip_error(cells, young=1e6, density=1e3, length=1.0, height=0.2, gravity=0.1):
    spacing, inertia, load = height / cells, height**3 / 12, density * gravity * height
    x, volume = lattice((-4 * spacing, 0.0), (length, height), spacing / 2)
    grid = Grid.covering((-4 * spacing - 0.05, -0.3), (length + 0.1, height + 0.1), spacing)
    pitch = 1.875**2 * math.sqrt(young * inertia / (density * height)) / length**2  # [rad/s]
    material = solid(young, 0.0, density, mass_damping=1.6 * pitch)  # nearly critical
    background = Background(grid, gravity=gravity)
    solver = Block.make(background, volume, material, float(stable_step(background, material)))
    handle = jnp.array([[-4 * spacing, height / 2]])
    held = np.flatnonzero(np.asarray(x)[:, 0] < 0)
    grip = jnp.asarray(held), jnp.zeros(len(held), int), x[held] - handle
    solver = eqx.tree_at(lambda s: (s.pinned, s.gripper_of, s.offset), solver, grip)
    substeps = math.ceil(12 / pitch / solver.dt)
    control = Control(jnp.broadcast_to(handle, (substeps, 1, 2)))
    end = eqx.filter_jit(r2s.simulate)(
        solver, material, solver.init(x), control, save_every=substeps
    ).final_state
    tip = np.asarray(x)[:, 0] > length - spacing / 2
    found = np.mean(np.asarray(x - end.x)[tip, 1])
    along = float(np.max(x[:, 0]))
    bent = along**2 * (6 * length**2 - 4 * length * along + along**2) / (24 * young * inertia)
    sheared = (length * along - along**2 / 2) / (5 / 6 * young / 2 * height)
    return abs(found / (load * (bent + sheared)) - 1)


@pytest.mark.slow(group="mpm")
def test_walls_hold_a_block_in():
    background = box(2, 8, gravity=0.0, walls=5)
    solver, material, x = small_block(2)
    solver = dataclasses.replace(solver, background=background)
    moved = states(solver, material, solver.init(x, jnp.full(x.shape, 2.0)), still(400, 2))
    assert np.max(moved.x) < 1 + 1 / 8
    assert np.mean(moved.v[-1]) < 0  # it came back


def test_grippers_carry_their_particles_exactly_and_the_rest_follows():
    solver, material, x = small_block(2, material=solid(2e4, 0.2, damping=2e-3))
    handle = jnp.array([[0.5, 0.6]])
    solver = solver.gripped(x, handle, 0.09)
    time = jnp.arange(1, 401).reshape(400, 1, 1) / 400
    path = handle[None] + time * jnp.array([[[0.1, 0.15]]])
    moved = states(solver, material, solver.init(x), Control(path))
    held = np.asarray(solver.pinned)
    assert 1 < len(held) < len(x)
    expected = np.asarray(path + solver.offset[None])
    assert np.asarray(moved.x)[:, held] == pytest.approx(expected, abs=1e-14)
    shift = np.asarray(moved.x)[-1] - np.asarray(x)
    assert shift == pytest.approx(np.broadcast_to([0.1, 0.15], shift.shape), abs=0.03)
    with pytest.raises(ValueError, match="gripper 1 finds no particle within 0.1 m"):
        solver.gripped(x, jnp.array([[0.5, 0.6], [0.9, 0.9]]), 0.1)


def test_a_step_above_the_limit_is_refused_with_the_limit():
    solver, material, x = small_block(2)
    limit = float(stable_step(solver.background, material))
    with pytest.raises(ValueError, match=f"limited by .* to {limit:.4g} s, got dt = 0.1 s"):
        Block.make(solver.background, solver.volume, material, 0.1)
    with pytest.raises(ValueError, match="limited"):
        solver.check(solid(1e7))
    eqx.filter_jit(solver.check)(solid(1e7))  # traced: not checked
    with pytest.raises(ValueError, match="limited"):  # damping shortens it
        Block.make(solver.background, solver.volume, solid(damping=1.0), solver.dt)


@pytest.mark.slow(group="mpm")
@pytest.mark.parametrize("factor, stays", [(1.0, True), (2.5, False)])
def test_the_limit_is_where_a_block_starts_to_explode(factor, stays):
    solver, material, x = small_block(2, gravity=0.0)
    limit = float(stable_step(solver.background, material))
    solver = dataclasses.replace(solver, dt=factor * limit)
    noise = 1e-3 * jax.random.normal(jax.random.key(0), x.shape)
    moved = states(solver, material, solver.init(x, noise), still(400, 2))
    speed = np.sqrt(np.mean(np.asarray(moved.v[-1]) ** 2))
    assert (speed < 2e-3) == stays


@pytest.mark.slow(group="mpm")
def test_a_particle_outside_is_refused_and_one_that_leaves_is_recorded():
    solver, material, x = small_block(2, gravity=0.0)
    with pytest.raises(ValueError, match="outside the grid"):
        solver.init(x + 2)
    start = solver.init(x, jnp.full(x.shape, 5.0))
    controls = still(240, 2)
    run = eqx.filter_jit(r2s.simulate)(solver, material, start, controls, save_every=60)
    assert run.ok.tolist() == [True, True, False, False]
    moved = states(solver, material, start, controls)
    code, step = failed(moved)
    assert code == run.result == Result.GRID
    assert float(run.failed_at) == pytest.approx((step + 1) * solver.dt) and step // 60 == 2
    assert np.isfinite(moved.x[step - 1]).all() and not np.isfinite(moved.x[step]).all()
    assert np.isfinite(moved.F[step]).all()


def failed(moved):
    """The code of the failure at the end of a motion, and the first step that has it."""
    codes = np.asarray(moved.failure)
    assert codes.tolist() == sorted(codes, key=bool)  # the first failure stays
    return Result(codes[-1]), int(np.argmax(codes != Result.SUCCESS))


@pytest.mark.slow(group="mpm")
def test_a_step_that_is_too_long_and_inputs_that_are_not_finite_are_named():
    solver, material, x = small_block(2, gravity=0.0)
    noise, controls = 1e-3 * jax.random.normal(jax.random.key(0), x.shape), still(240, 2)
    assert failed(states(solver, material, solver.init(x, noise), controls)) == (Result.SUCCESS, 0)
    windy = dataclasses.replace(controls, wind=jnp.zeros((240, 3)).at[65].set(jnp.nan))
    # the block leaves the grid afterwards, which does not hide it
    moved = states(solver, material, solver.init(x, jnp.full(x.shape, 5.0)), windy)
    assert not np.isfinite(moved.x[-1]).all()
    assert failed(moved) == (Result.NON_FINITE, 65)
    long = dataclasses.replace(solver, dt=4 * float(stable_step(solver.background, material)))
    with pytest.raises(ValueError, match="limited"):
        long.check(material)
    code, step = failed(states(long, material, long.init(x, noise), controls))
    assert code == Result.TIME_STEP and step > 2
