"""Explicit steps of the cloth: forces on the grid, falls, batches, and what is refused."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import flat

import r2s
from r2s._util.units import GRAVITY
from r2s.environment.air import Air, Fan
from r2s.environment.scene import Control, Scene
from r2s.materials.plate import PlateBending
from r2s.scenarios.energy import stored_energy
from r2s.solvers.explicit.cloth import ExplicitCloth, moved_velocity
from r2s.solvers.explicit.grid import sheet_force
from r2s.solvers.explicit.sheet import ForceInputs, cells_of, force_by_gathers, no_memory
from r2s.solvers.explicit.stability import SAFETY, Viscosity, longest_relaxing_step
from r2s.solvers.results import Result


def explicit(mesh, fabric, pinned=(), dt=0.01, table=None, **options):
    return ExplicitCloth(Scene(mesh, tuple(pinned), table, air=None), dt, fabric, **options)


def moved(solver, fabric, wind=(0.0, 0.0, 0.0), height=0.0, v=None, steps=1):
    """After some steps whose grippers stay."""
    x = flat(solver.scene.mesh, height)
    state = solver.init(x, v)
    control = Control(x[solver.scene.pinned], jnp.array(wind))
    run = eqx.filter_jit(solver.step)
    for _ in range(steps):
        state = run(fabric, state, control)
    return state


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("law", ["constant", "springs", "wrinkling"])
@pytest.mark.parametrize("shape", [(6, 5), (2, 5)])
def test_forces_on_the_grid_are_those_by_gathers(shape, law, fabric):
    mesh = r2s.rectangle((0.3, 0.2), shape, "wrinkling" if law == "wrinkling" else "quadrilaterals")
    fabric = dataclasses.replace(fabric, bending=PlateBending.make(1e-3, 0.3))
    if law == "springs":
        springs = r2s.SpringMembrane(*(jnp.asarray(c) for c in (300.0, 200.0, 80.0)))
        fabric = dataclasses.replace(fabric, membrane=springs)
    x = flat(mesh) + 0.01 * jax.random.normal(jax.random.key(0), (mesh.rest.shape[0], 3))
    v = jax.random.normal(jax.random.key(1), x.shape)
    cells, viscosity = cells_of(mesh), Viscosity(jnp.asarray(3.0), jnp.asarray(0.2))
    fan = Fan(*(jnp.asarray(v) for v in ((0.1, 0.1, -0.2), (0.0, 0.3, 1.0), 0.1, 0.05)))
    none = no_memory(mesh, cells, x.dtype)
    past = jax.random.normal(jax.random.key(2), none.relaxed.shape)
    memory, wind = none._replace(relaxed=past, begun=jnp.asarray(True)), jnp.array([0.0, 2.0, 5.0])
    inputs = ForceInputs(fabric, viscosity, Air.make(), fan, x, v, wind, memory)
    expected, remembered = jax.jit(partial(force_by_gathers, mesh))(inputs)
    run = jax.jit(partial(sheet_force, mesh, cells))
    force = hidden = None
    for _ in range(12):  # of Newton's method for the wrinkles
        force, after = run(inputs)
        hidden = after.hidden
        inputs = inputs._replace(memory=memory._replace(hidden=hidden))
    assert (hidden is not None) == (law == "wrinkling")
    assert force == pytest.approx(np.asarray(expected), rel=1e-9, abs=1e-11)
    assert after.relaxed == pytest.approx(np.asarray(remembered.relaxed), rel=1e-9, abs=1e-9)


@pytest.mark.slow(group="cloth")
def test_a_free_sheet_falls_as_a_stone(sheet, fabric):
    solver = explicit(sheet, fabric)
    after = moved(solver, fabric)
    count, small = solver.substeps, solver.dt / solver.substeps
    fallen = -GRAVITY * small**2 * count * (count + 1) / 2
    assert after.x == pytest.approx(np.asarray(flat(sheet, fallen)), abs=1e-12)
    assert int(after.failure) == Result.SUCCESS
    broken = solver.init(flat(sheet).at[0, 0].set(jnp.nan))
    still = Control(jnp.zeros((0, 3)), jnp.zeros(3))
    failure = eqx.filter_jit(solver.step)(fabric, broken, still).failure
    assert int(failure) == Result.NON_FINITE


@pytest.mark.slow(group="cloth")
def test_a_batch_is_its_members(sheet, fabric):
    solver = explicit(sheet, fabric, pinned=(0, 4))
    start = solver.init(flat(sheet))
    control = Control(flat(sheet)[jnp.array([0, 4])] + 0.002, jnp.array([0.5, 0.0, 0.0]))
    membrane = fabric.membrane
    scales = jnp.array([0.5, 0.8, 1.0, 0.9])

    def end(softer, lighter):
        of = eqx.tree_at(lambda f: f.membrane, fabric, jax.tree.map(lambda c: c * softer, membrane))
        of = eqx.tree_at(lambda f: f.density, of, fabric.density / lighter)
        return solver.step(of, start, control).x

    alone = jnp.stack([eqx.filter_jit(end)(s, jnp.ones(())) for s in scales])
    batch = eqx.filter_jit(jax.vmap(end))(scales, jnp.ones(4))
    assert batch == pytest.approx(np.asarray(alone), abs=1e-10)
    nested = eqx.filter_jit(jax.vmap(jax.vmap(end, (0, None)), (None, 0)))(scales, jnp.ones(2))
    assert nested[1] == pytest.approx(np.asarray(alone), abs=1e-10)
    held = np.asarray(alone)[:, [0, 4]]
    assert held == pytest.approx(np.broadcast_to(control.pinned, held.shape), abs=0)


def test_friction_on_the_table_is_its_coefficient_times_what_presses():
    dt, friction, speed = jnp.asarray(1e-3), jnp.asarray(0.4), jnp.asarray([0.6])
    v = speed, 0 * speed, jnp.asarray([-0.05])
    height, still = jnp.asarray([-1e-4]), 0 * speed
    fabric = jnp.asarray(0.2), friction, jnp.zeros(()), jnp.asarray(GRAVITY)
    after = moved_velocity(dt, (still, still, still), jnp.ones(1), v, height, *fabric)
    pushed = after[2] - v[2] + dt * GRAVITY  # normal impulse per mass, [m/s]
    assert pushed[0] > 0.01
    assert speed - after[0] == pytest.approx(np.asarray(friction * pushed), rel=1e-3)


@pytest.mark.slow(group="cloth")
def test_friction_stops_a_sliding_sheet_after_the_way_of_coulomb(fabric):
    """Speed falls by friction times gravity a second."""
    mesh = r2s.rectangle((0.3, 0.2), (3, 3), "quadrilaterals")
    rest = fabric.thickness - 1e-4
    solver = explicit(mesh, fabric, table=0.0, dt=0.01)
    v = jnp.zeros((9, 3)).at[:, 0].set(0.3)
    slid = moved(solver, fabric, height=rest, v=v, steps=3)
    lost = 0.3 - jnp.mean(slid.v[:, 0])
    assert float(lost) == pytest.approx(float(fabric.friction) * GRAVITY * 0.03, rel=0.05)
    assert float(jnp.mean(moved(solver, fabric, height=rest, v=v, steps=30).v[:, 0])) < 1e-3


@pytest.mark.slow(group="cloth")
def test_a_motion_in_explicit_steps_has_its_derivative(fabric):
    sheet = r2s.rectangle((0.2, 0.2), (3, 3), "quadrilaterals")
    solver = explicit(sheet, fabric, pinned=(0,), dt=0.005)
    start = solver.init(flat(sheet))
    control = Control(flat(sheet)[:1], jnp.zeros(3))

    def sagged(factor):
        of = dataclasses.replace(fabric, bending=PlateBending.make(1e-4 * factor, jnp.zeros(())))
        return jnp.sum(solver.step(of, start, control).x[:, 2] ** 2)

    sagged = jax.jit(sagged)
    step = 1e-4
    difference = (sagged(1 + step) - sagged(1 - step)) / (2 * step)
    forward = jax.jit(jax.jacfwd(sagged))(1.0)
    assert float(forward) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow(group="cloth")
def test_a_fabric_that_is_too_stiff_for_the_substeps_is_refused_or_fails(sheet, fabric):
    solver = explicit(sheet, fabric, pinned=(0,))
    stiff = dataclasses.replace(fabric, membrane=jax.tree.map(lambda c: 3 * c, fabric.membrane))
    control = Control(jnp.zeros((2, 1, 3)))

    def move(fabric):
        return r2s.simulate(solver, fabric, solver.init(flat(sheet)), control)

    with pytest.raises(ValueError, match="limited by the fabric"):
        move(stiff)
    run = eqx.filter_jit(move)  # in which it is traced
    assert bool(run(fabric).ok.all())
    failed = run(stiff)  # though nothing has exploded yet
    assert int(failed.result) == Result.TIME_STEP and bool(jnp.isfinite(failed.x).all())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"substeps": -5}, "whole number"),
        ({"dt": jnp.inf}, "dt must be positive"),
        ({"substeps": 1}, "limited by the fabric"),
        ({"self_contact": True}, "contact of the sheet with itself.*mpm_cloth"),
        ({"density": 0.0}, "density and its stiffness must be positive"),
        ({"density": jnp.nan}, "density and its stiffness must be positive"),
    ],
)
def test_what_cannot_be_stepped_is_refused(sheet, fabric, options, message):
    density = jnp.asarray(options.pop("density", fabric.density))
    with pytest.raises(ValueError, match=message):
        explicit(sheet, dataclasses.replace(fabric, density=density), **options)


def test_a_traced_fabric_gives_no_substeps(sheet, fabric):
    with pytest.raises(ValueError, match="must not be traced"):
        jax.jit(lambda fabric: explicit(sheet, fabric).substeps)(fabric)


@pytest.mark.parametrize("relaxation", [0.0, 1e-3, 1e-2])
def test_the_longest_step_is_where_a_relaxing_spring_begins_to_explode(relaxation):
    square, damping = 4e6, 5e-3  # [1/s^2], [s]
    times = jnp.asarray(damping), jnp.asarray(relaxation)
    none = [(jnp.zeros(()), jnp.zeros(()))]
    limit = float(longest_relaxing_step(jnp.asarray(square), *times, none)) / SAFETY

    def growth(dt):
        """Of the fastest mode of position, dt times velocity and relaxed position."""
        share, rate = (float(part) for part in Viscosity.make(*times, jnp.asarray(dt)))
        k = dt**2 * square
        v = np.array([-k * (1 + share), 1, k * share])
        matrix = np.array([v + [1, 0, 0], v, [rate, 0, 1 - rate]])
        return np.abs(np.linalg.eigvals(matrix)).max()

    assert growth(0.999 * limit) < 1 + 1e-9
    assert growth(1.001 * limit) > 1


def test_slow_changes_are_damped_as_by_kelvin_and_voigt_and_sudden_ones_stiffened():
    damping, relaxation, dt, rate = 0.01, 2e-3, 5e-4, 30.0  # [s], [s], [s], [N/(m s)]
    times = (jnp.asarray(time) for time in (damping, relaxation, dt))
    viscosity, relaxed = Viscosity.make(*times), jnp.zeros(())
    begun = jnp.asarray(True)
    stress = total = jnp.zeros(())
    for count in range(1, 101):
        stress = jnp.asarray(rate * dt * count)
        total, relaxed = viscosity.resist(stress, relaxed, begun)
    assert float(total - stress) == pytest.approx(damping * rate, rel=1e-6)
    sudden, _ = viscosity.resist(jnp.ones(()), jnp.zeros(()), begun)
    assert float(sudden) == pytest.approx(1 + damping / (relaxation + dt))
    first, caught_up = viscosity.resist(jnp.ones(()), jnp.zeros(()), ~begun)
    assert float(first) == float(caught_up) == 1.0


def test_a_free_sheet_keeps_its_momentum_and_loses_energy(sheet, fabric):
    solver = explicit(sheet, fabric, dt=0.01)
    v = jax.random.normal(jax.random.key(3), (len(sheet.rest), 3))
    state, run = solver.init(flat(sheet), v), eqx.filter_jit(solver.step)
    stored_of = jax.jit(lambda x: stored_energy(sheet, fabric, x))
    mass = fabric.density * sheet.vertex_area[:, None]
    control = Control(jnp.zeros((0, 3)), jnp.zeros(3))
    momentum, energies = jnp.sum(mass * v, axis=0), []
    for count in range(1, 6):
        state = run(fabric, state, control)
        fallen = jnp.sum(mass) * jnp.array([0.0, 0.0, -GRAVITY]) * count * solver.dt
        now = jnp.sum(mass * state.v, axis=0)
        assert now == pytest.approx(np.asarray(momentum + fallen), abs=1e-12)
        relative = state.v - now[None] / jnp.sum(mass)
        stored = stored_of(state.x)
        energies.append(float(stored + jnp.sum(mass * relative**2) / 2))
    assert np.all(np.diff(energies) < 0)


@pytest.mark.slow(group="cloth")
def test_grippers_carry_the_weight_of_a_sheet_at_rest(fabric):
    """On any mesh and on the grid, and through the account of energy."""
    scenario = r2s.wind((0.2, 0.2), speed=0.0, num_frames=3).scenario((4, 4))
    solver = r2s.explicit_cloth(scenario, fabric)
    weight = float(fabric.density) * 0.04 * GRAVITY
    for each in (solver, dataclasses.replace(solver, grid=None)):
        found = eqx.filter_jit(r2s.energy_balance)(scenario, fabric, None, each)
        assert float(jnp.sum(found.forces[-1], axis=0)[2]) == pytest.approx(weight, rel=1e-3)
        assert float(found.dissipated[-1]) > -1e-6


@pytest.mark.slow(group="cloth")
def test_explicit_steps_of_a_lift_go_where_small_implicit_ones_go(fabric):
    scenario = r2s.lifting((0.3, 0.3), num_frames=12, moving=0.6).scenario((5, 5))
    run = eqx.filter_jit(r2s.rollout)
    fine = run(scenario, fabric, 1 / 480).x
    explicit = run(scenario, fabric, None, r2s.explicit_cloth(scenario, fabric)).x
    light = r2s.explicit_cloth(scenario, fabric, membrane_damping=1e-4)
    apart, lightly = (
        float(jnp.sqrt(jnp.mean(jnp.sum((x - fine) ** 2, axis=2))))
        for x in (explicit, run(scenario, fabric, None, light).x)
    )
    assert apart < 1e-3
    assert lightly > 3 * apart  # the membrane's damping is felt
