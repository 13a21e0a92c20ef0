"""Explicit steps of the cloth: forces on the grid, falls, batches, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat, step

import r2s
from r2s.cloth.explicit import ExplicitCloth, stable_step
from r2s.failures import Failure
from r2s.forces.elements import elastic_force
from r2s.forces.grid import grid_force, laws_on_grid
from r2s.forces.layout import Layout
from r2s.laws.plate import PlateBending
from r2s.units import GRAVITY
from r2s.world.air import Air
from r2s.world.contact import Table
from r2s.world.drag import drag_on_vertices
from r2s.world.scene import Control, Scene


def explicit(mesh, fabric, held=(), dt=0.01, table=-jnp.inf, **options):
    scene = Scene(mesh, jnp.asarray(tuple(held), int), Table.make(table), Air.make(density=0.0))
    return ExplicitCloth.make(scene, dt, fabric, **options)


@pytest.mark.parametrize("elements", ["quadrilaterals", "wrinkling"])
@pytest.mark.parametrize("shape", [(6, 5), (2, 5)])
def test_forces_on_the_grid_are_those_by_gathers(shape, elements, fabric):
    mesh = r2s.rectangle((0.3, 0.2), shape, elements)
    fabric = eqx.tree_at(lambda f: f.bending, fabric, PlateBending.make(1e-3, 0.3))
    x = flat(mesh) + 0.01 * jax.random.normal(jax.random.key(0), (mesh.rest.shape[0], 3))
    v = jax.random.normal(jax.random.key(1), x.shape)
    layout = Layout(shape, (0.3 / (shape[0] - 1), 0.2 / (shape[1] - 1)))
    laws = laws_on_grid(layout, fabric, jnp.asarray(0.01), elements == "wrinkling")
    none = jnp.zeros(layout.length(layout.first_cell))
    hidden = ((none,) * 3,) * 4 if elements == "wrinkling" else None
    wide, rates = layout.wide(x), layout.wide(v)
    run = jax.jit(lambda hidden: grid_force(layout, laws, Air.make(), wide, rates, rates, hidden))
    for _ in range(12):  # of Newton's method for the wrinkles
        found, hidden = run(hidden)
    expected = elastic_force(mesh, fabric, jnp.asarray(0.01), x, v)
    expected += drag_on_vertices(mesh, Air.make(), None, x, v, jnp.zeros(3))
    assert jnp.stack(found, axis=1) == pytest.approx(np.asarray(expected), rel=1e-9, abs=1e-11)


def test_a_free_sheet_falls_as_a_stone(sheet, fabric):
    solver = explicit(sheet, fabric)
    moved = eqx.filter_jit(solver.step)(
        fabric, solver.init(flat(sheet)), Control(jnp.zeros((0, 3)), jnp.zeros(3))
    )
    count, small = solver.substeps, solver.dt / solver.substeps
    fallen = -GRAVITY * small**2 * count * (count + 1) / 2
    assert moved.x == pytest.approx(np.asarray(flat(sheet, fallen)), abs=1e-12)
    assert int(moved.failure) == Failure.NONE


def test_a_batch_is_its_members(sheet, fabric):
    solver = explicit(sheet, fabric, held=(0, 4))
    start = solver.init(flat(sheet))
    control = Control(flat(sheet)[jnp.array([0, 4])] + 0.002, jnp.array([0.5, 0.0, 0.0]))
    membrane = fabric.membrane
    scales = jnp.array([0.5, 0.8, 1.0, 0.9])

    def moved(softer, lighter):
        of = eqx.tree_at(lambda f: f.membrane, fabric, jax.tree.map(lambda c: c * softer, membrane))
        of = eqx.tree_at(lambda f: f.density, of, fabric.density / lighter)
        return solver.step(of, start, control).x

    alone = jnp.stack([eqx.filter_jit(moved)(s, jnp.ones(())) for s in scales])
    batch = eqx.filter_jit(jax.vmap(moved))(scales, jnp.ones(4))
    assert batch == pytest.approx(np.asarray(alone), abs=1e-10)
    nested = eqx.filter_jit(jax.vmap(jax.vmap(moved, (0, None)), (None, 0)))(scales, jnp.ones(2))
    assert nested[1] == pytest.approx(np.asarray(alone), abs=1e-10)
    held = np.asarray(alone)[:, [0, 4]]
    assert held == pytest.approx(np.broadcast_to(control.handles, held.shape), abs=0)


def test_too_few_substeps_and_self_contact_are_refused(sheet, fabric):
    limit = float(stable_step(sheet, fabric))
    with pytest.raises(ValueError, match=f"limited by .* to {limit:.4g} s"):
        explicit(sheet, fabric, dt=2 * limit, substeps=1)
    with pytest.raises(ValueError, match="contact of the sheet with itself"):
        explicit(sheet, fabric, self_contact=True)


def test_a_step_that_explodes_is_a_recorded_failure(sheet, fabric):
    solver = explicit(sheet, fabric)
    start = solver.init(flat(sheet).at[0, 0].set(jnp.nan))
    control = Control(jnp.zeros((0, 3)), jnp.zeros(3))
    assert int(eqx.filter_jit(solver.step)(fabric, start, control).failure) == Failure.NON_FINITE


def test_a_short_hang_is_that_of_small_implicit_steps(sheet, fabric):
    fabric = eqx.tree_at(lambda f: f.damping, fabric, jnp.asarray(1e-3))
    held = jnp.array([0, 20])
    solver = explicit(sheet, fabric, held=(0, 20), membrane_damping=1e-3)
    implicit = cloth(sheet, held=(0, 20), dt=1 / 800)
    control = Control(flat(sheet)[held], jnp.zeros(3))
    state, other = solver.init(flat(sheet)), implicit.init(flat(sheet))
    run = eqx.filter_jit(solver.step)
    for _ in range(10):
        state = run(fabric, state, control)
    for _ in range(80):
        other = step(implicit, fabric, other, control)
    moved = jnp.max(jnp.abs(state.x - flat(sheet)))
    assert moved > 0.02
    assert jnp.max(jnp.abs(state.x - other.x)) < 0.05 * moved
