"""The generalised-alpha method beside BDF2: order, energy, contact, forces, gradient."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DT, FIRST_ROW, SIZE, cloth, energy, everywhere, flat, hanging, roll

from r2s._util.units import AIR_DENSITY, GRAVITY
from r2s.environment import contact
from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.solvers.implicit.cloth import ImplicitCloth
from r2s.solvers.implicit.generalised_alpha import coefficients

RADIUS = 0.6
LAW = (300.0, 60.0, 200.0, 80.0)  # [N/m]


def by_alpha(solver: ImplicitCloth, spectral_radius: float = RADIUS) -> ImplicitCloth:
    return dataclasses.replace(solver, spectral_radius=spectral_radius)


@pytest.mark.parametrize("spectral_radius", [0.0, 0.6, 0.9])
def test_the_fastest_vibrations_are_damped_to_the_spectral_radius(spectral_radius):
    """An undamped oscillator, a' = -rate^2 x', at rate dt = 1e6: eigenvalues of a step's matrix."""
    mass, force, beta, gamma = coefficients(spectral_radius)
    squared = 1e12
    new = np.zeros((3, 3))
    old = np.zeros((3, 3))  # new (x', v', a') = old (x, v, a), with dt = 1
    new[0], old[0] = (1, 0, -beta), (1, 1, 0.5 - beta)
    new[1], old[1] = (0, 1, -gamma), (0, 1, 1 - gamma)
    new[2], old[2] = ((1 - force) * squared, 0, 1 - mass), (-force * squared, 0, -mass)
    largest = np.max(np.abs(np.linalg.eigvals(np.linalg.solve(new, old))))
    assert largest == pytest.approx(spectral_radius, abs=2e-3)


@pytest.mark.slow(group="cloth")
def test_a_smooth_swing_converges_to_second_order_with_less_error_than_by_bdf2(sheet):
    """In air, with viscosity, whose drag and stiffness must not lag behind."""
    fabric = Fabric.make(0.2, LAW, 1e-3, damping=0.01)
    still = by_alpha(cloth(sheet, FIRST_ROW))
    damped = Fabric.make(0.2, LAW, 1e-3, damping=0.05)
    start = jnp.asarray(roll(still, damped, still.init(hanging(sheet)), 400).x[-1])

    def path(t):
        return start[:5] + jnp.array([[0.03 * np.sin(np.pi * t / 0.4) ** 4, 0.0, 0.0]])

    def end(refinement, spectral_radius):
        solver = cloth(sheet, FIRST_ROW, air=AIR_DENSITY, dt=DT / refinement)
        solver = dataclasses.replace(solver, spectral_radius=spectral_radius)
        return roll(solver, fabric, solver.init(start), 30 * refinement, path).x[-1]

    ends = {radius: [end(n, radius) for n in (1, 2, 4, 8)] for radius in (RADIUS, None)}
    for of in ends.values():
        steps = [np.linalg.norm(a - b) for a, b in zip(of[:-1], of[1:], strict=True)]
        assert all(2**1.7 < a / b < 2**2.3 for a, b in zip(steps[:-1], steps[1:], strict=True))
    exact = ends[RADIUS][3] + (ends[RADIUS][3] - ends[RADIUS][2]) / 3
    errors = [np.linalg.norm(ends[radius][1] - exact) for radius in (RADIUS, None)]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.slow(group="cloth")
def test_a_swing_loses_less_energy_than_by_bdf2(sheet, fabric):
    lost, scale = [], 0.2 * SIZE**3 * GRAVITY / 2  # weight times half the length
    for solver in (cloth(sheet, FIRST_ROW), by_alpha(cloth(sheet, FIRST_ROW))):
        states = roll(solver, fabric, solver.init(hanging(sheet, np.deg2rad(20))), 100)
        energies = jax.vmap(lambda x, v: energy(sheet, fabric, x, v))(states.x, states.v)
        lost.append(float(energies[0] - energies[-1]) / scale)
        assert jnp.max(energies) < energies[0] + 1e-4 * scale
    assert 0 < lost[1] < 0.8 * lost[0]  # the rest is of the fastest vibrations


@pytest.mark.slow(group="cloth")
def test_a_sheet_that_falls_onto_a_table_comes_to_rest_on_it(sheet, fabric):
    solver = by_alpha(cloth(sheet, table=0.0))
    down = everywhere([0.0, 0.0, -GRAVITY], sheet)
    start = solver.init(flat(sheet, 5e-3), everywhere([0.3, 0.0, 0.0], sheet), down)
    states = roll(solver, fabric, start, 60)
    speed = np.linalg.norm(states.v, axis=-1).max(axis=1)
    assert speed[-1] < 1e-4
    slid = states.x[-1, :, 0] - states.x[0, :, 0]
    assert np.all(slid > 2e-3) and np.all(slid < 0.1)
    pressed = 0.2 * GRAVITY / 4e8  # depth squared at which the table carries the weight
    depth = float(fabric.thickness) - states.x[-1, :, 2]
    assert np.mean(depth**2) == pytest.approx(pressed, rel=1e-3)

    def held(x, v):
        table = contact.normal_potential(solver.scene.table.depth(x, fabric.thickness))
        return energy(sheet, fabric, x, v) + jnp.sum(sheet.vertex_area * table)

    energies = jax.vmap(held)(states.x, states.v)
    assert np.all(np.diff(energies) < 1e-3 * (energies[0] - energies[-1]))


@pytest.mark.slow(group="cloth")
def test_what_does_not_go_is_refused(sheet, fabric):
    scene = cloth(sheet, FIRST_ROW, table=0.0).scene
    for wrong in (-0.1, 1.0):
        with pytest.raises(ValueError, match=r"spectral_radius must be from 0 to below 1"):
            ImplicitCloth(scene, DT, spectral_radius=wrong)
    with pytest.raises(ValueError, match="self-contact"):
        ImplicitCloth(scene, DT, self_contact=True, spectral_radius=RADIUS)
    by_bdf2, solver = ImplicitCloth(scene, DT), ImplicitCloth(scene, DT, spectral_radius=RADIUS)
    start = by_bdf2.init(flat(sheet))
    with pytest.raises(ValueError, match="begin with this solver's `init`"):
        solver.step(fabric, start, Control(start.x[:5], jnp.zeros(3)))
