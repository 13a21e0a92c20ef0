"""The six scenarios on both solvers: what must hold of any fabric, forces and energies."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s import scenarios
from r2s._util.units import GRAVITY
from r2s.materials import presets
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.tables import HINGE_FACTOR, TableBending
from r2s.mesh.mesh import rectangle
from r2s.recordings.recording import RecordingInfo, make_recording
from r2s.scenarios.energy import stored_energy
from r2s.scenarios.paths import Route
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import from_recording, rollout
from r2s.scenarios.standard import CLEARANCE, SCENARIOS

SHAPE = (5, 5)
SOFTEST, STIFFEST = "grey_interlock", "black_denim"

account = eqx.filter_jit(scenarios.energy_balance)


def stretch(mesh, x):
    """The greatest principal stretch less one [-] of every strain sample, (frame, sample)."""
    found = np.asarray(jax.vmap(mesh.samples.strains)(x))
    e11, e22, shear = found.reshape(len(found), -1, 3).transpose(2, 0, 1)
    return np.sqrt(1 + e11 + e22 + np.hypot(e11 - e22, shear)) - 1


def solver_of(kind, scenario, fabric):
    return scenarios.mpm_cloth(scenario, fabric) if kind == "mpm" else None


def check(scenario, fabric, found):
    """What must hold of any motion."""
    x = np.asarray(found.x)
    assert np.all(np.isfinite(x))
    table = float(scenario.scene.table.height)
    assert x[..., 2].min() >= table  # the contact begins a thickness above it
    given = np.ptp(np.asarray(found.grippers)) + np.ptp(np.asarray(found.air))
    lost = np.diff(np.asarray(found.dissipated))
    assert lost.min() > -0.02 * given  # nothing comes from nowhere
    assert found.dissipated[-1] > 0
    mass = float(fabric.density) * float(jnp.sum(scenario.scene.mesh.area))
    assert found.kinetic[0] < mass / 2 * 0.01**2  # it starts at rest, to 1 cm/s


@pytest.fixture(scope="module")
def shaken():
    """A fabric in the scenario, the motion with its energies, and the grippers' forces."""
    fabric = presets.FIVE[STIFFEST]()
    experiment = scenarios.shaking(num_frames=8, interval=1 / 10, fade=0.2, still=0.1)
    scenario = experiment.scenario(SHAPE)
    return scenario, fabric, account(scenario, fabric)


def test_a_hanging_sheet_starts_at_rest_and_loses_what_it_is_given(shaken):
    scenario, fabric, found = shaken
    check(scenario, fabric, found)
    middle = np.asarray(found.x[0])[SHAPE[1] // 2 :: SHAPE[1]].mean(axis=0)
    assert middle[2] < 0.7 - 0.4 * 0.45  # it hangs


def test_work_of_the_air_that_a_sheet_does_not_keep_is_dissipated(shaken):
    _, _, found = shaken
    blown = dataclasses.replace(found, air=found.air + 1.0)
    assert blown.dissipated - found.dissipated == pytest.approx(1.0)


def test_grippers_bear_the_weight(shaken):
    _, fabric, found = shaken
    weight = float(fabric.density) * 0.45**2 * GRAVITY
    held = np.asarray(found.forces)
    assert held[0].sum(axis=0) == pytest.approx([0, 0, weight], abs=0.01 * weight)
    assert held[0, 0, 0] < 0 < held[0, 1, 0]  # they pull the top edge taut
    assert held[0, 0] == pytest.approx(held[0, 1] * [-1, 1, 1], abs=0.05 * weight)


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("kind", ["cloth", "mpm"])
def test_a_uniaxial_pull_has_the_force_of_the_law(kind):
    """Without Poisson's effect and friction: C11 E11 (1 + strain) on the width, E11 Green's."""
    stiffness, strain, size = 100.0, 0.04, (0.3, 0.2)
    fabric = Fabric.make(0.2, (stiffness, 0.0, 100.0, 40.0), 1e-5, friction=0.0)
    experiment = scenarios.stretching(size, num_frames=15, strain=strain, moving=0.2)
    scenario = experiment.scenario((5, 4))
    found = account(scenario, fabric, None, solver_of(kind, scenario, fabric))
    force = np.asarray(scenarios.clamp_force(scenario, found))
    expected = stiffness * (strain + strain**2 / 2) * (1 + strain) * size[1]
    assert force[-1, 0] == pytest.approx(expected, rel=1e-3 if kind == "cloth" else 0.01)
    assert expected == pytest.approx(stiffness * strain * size[1], rel=0.07)  # small strains
    assert force[0, 0] == pytest.approx(0, abs=0.01 * expected)


def test_a_wind_of_no_speed_is_none():
    scenario = scenarios.wind(speed=0.0, num_frames=3).scenario((3, 3))
    assert scenario.scene.fan is None and scenario.controls(1).wind is None


def test_wind_blows_in_the_middle_after_the_first_frame():
    scenario = scenarios.wind(speed=3.0, aside=90.0).scenario(SHAPE)
    controls = scenario.controls(2)
    blows = np.asarray(controls.wind)
    before = scenario.lead_in * 2
    np.testing.assert_array_equal(blows[:before], 0)
    np.testing.assert_allclose(blows[-1], [3, 0, 0], atol=1e-12)
    middle = jnp.array([[0.225, 0.0, 0.7 - 0.225], [0.225, 0.0, 0.7]])
    fan = scenarios.wind(speed=3.0).scenario(SHAPE).scene.fan
    assert fan is not None
    strength = np.asarray(fan(middle))
    assert strength[0] > 0.98 and strength[1] < 0.25


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_recording_of_an_experiment_is_of_the_same_scenario(name):
    experiment = SCENARIOS[name]()
    sheet = experiment.sheet
    info = RecordingInfo("a", name, "b", "1", "c", (0, 59), sheet, 0.0, None, wind=experiment.wind)
    clouds, (times, path) = [np.zeros((1, 3))] * 60, experiment.route
    record = make_recording(clouds, experiment.times, path, times, info)
    again, first = from_recording(record, SHAPE), experiment.scenario(SHAPE)
    assert jax.tree.structure(again) == jax.tree.structure(first)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(first), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=1e-9)


def test_any_size_and_any_recorded_path():
    times = np.array([0.0, 0.2, 0.5, 4.0])
    path = np.array([[[0.0, 0.3, CLEARANCE]], [[0.0, 0.3, 0.1]], [[0.1, 0.2, 0.2]]])
    route = Route(times, np.concatenate([path, path[-1:]]))
    experiment = scenarios.lifting((0.5, 0.3), "weft", route=route)
    scenario = experiment.scenario((6, 4))
    assert int(scenario.scene.pinned[0]) == 3
    np.testing.assert_allclose(np.asarray(scenario.controls(2).pinned)[-1], path[-1])
    assert float(jnp.max(scenario.scene.mesh.rest)) == 0.5


def test_both_sides_of_a_stretching_are_clamped_straight():
    scenario = scenarios.stretching((0.3, 0.2), strain=0.1).scenario((5, 4))
    pinned = np.asarray(scenario.scene.pinned)
    assert sorted(pinned) == [0, 1, 2, 3, 16, 17, 18, 19]
    end = np.asarray(scenario.controls(1).pinned)[-1]
    rest = np.asarray(scenario.scene.mesh.rest)[pinned]
    pulled = rest[:, 0] > 0.2
    np.testing.assert_allclose(end[:, 0], rest[:, 0] + 0.03 * pulled, atol=1e-12)
    np.testing.assert_allclose(end[:, 1], rest[:, 1], atol=1e-12)


@pytest.mark.slow(group="motions")
def test_material_points_fit_the_scenario():
    """Their grid covers where the sheet can be, and meets the table; their steps fill a frame."""
    scenario, fabric = scenarios.lifting(height=0.3).scenario(SHAPE), presets.black_denim()
    solver = scenarios.mpm_cloth(scenario, fabric)
    grid = solver.background.grid
    assert np.min(np.abs(np.asarray(grid.axes[2]))) < 1e-12  # a node on the table
    far = np.array([[0.0, 0.0, 0.3 + 0.63], [0.45, 0.45, 0.0], [-0.5, 0.0, 0.3]])
    assert np.all(np.asarray(grid.inside(jnp.asarray(far))))
    wrong = dataclasses.replace(solver, dt=solver.dt * 1.37)
    with pytest.raises(ValueError, match="fill the 0.0666667 s between frames"):
        rollout(scenario, fabric, solver=wrong)
    with pytest.raises(ValueError, match="comes from the grid"):
        mpm_cloth(SCENARIOS["folding"]().scenario(SHAPE, self_contact=True), fabric)


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("fabric", [SOFTEST, STIFFEST])
@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, kind) for name in SCENARIOS for kind in ("cloth", "mpm")] + [("folding", "layers")],
)
def test_every_scenario_on_every_solver(name, kind, fabric):
    made, shape = presets.FIVE[fabric](), (13, 13) if kind == "mpm" else (9, 9)
    scenario = SCENARIOS[name]().scenario(shape, self_contact=kind == "layers")
    found = account(scenario, made, None, solver_of(kind, scenario, made))
    check(scenario, made, found)
    stretched = stretch(scenario.scene.mesh, found.x)
    if fabric == STIFFEST:
        # all but the faces around a vertex that alone holds the weight
        assert np.quantile(stretched, 0.95, axis=1).max() < 0.05
    else:
        # a knit of 10 N/m (C11 - C12^2 / C22) under a weight of 0.8 N/m, shaken
        assert stretched.mean(axis=1).max() < 0.12 and stretched.max() < 1


@pytest.mark.slow(group="motions")
def test_the_energy_of_a_table_law_is_that_of_its_stiffness_there():
    mesh = rectangle((0.2, 0.2), (4, 4))
    fabric = presets.grey_interlock()
    x = jnp.concatenate([mesh.rest, 0.02 * jnp.sin(20 * mesh.rest[:, :1])], axis=1)

    def of(law):
        return float(stored_energy(mesh, dataclasses.replace(fabric, bending=law), x))

    table = TableBending(jnp.full((3, 5), HINGE_FACTOR * 1e-5))
    assert of(table) == pytest.approx(of(HingeBending(jnp.asarray(1e-5))), rel=1e-12)
