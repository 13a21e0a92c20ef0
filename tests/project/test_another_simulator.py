"""A fabric estimated from what DiffSim made predicts what else DiffSim made."""

import dataclasses

import diffsim_runs as runs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s._util.units import GRAVITY
from r2s.environment.scene import Scene
from r2s.estimation.method import Budget
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.mesh import rectangle
from r2s.scenarios.scenario import Scenario, begin, rollout, stepped
from r2s.solvers.implicit.cloth import ImplicitCloth

needs_data = pytest.mark.skipif(not runs.DATA.is_dir(), reason=f"no data in {runs.DATA}")
INTERVAL = 0.02  # [s]

_motion = eqx.filter_jit(rollout)


@pytest.fixture
def fabric():
    return Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5)


def dropped(air: float = 0.0, brake: float | None = None) -> Scenario:
    """A sheet that is let go, its first vertex held where it is; in vacuum."""
    mesh = rectangle((0.2, 0.2), (3, 3))
    start = jnp.pad(mesh.rest, ((0, 0), (0, 1)))
    falling = jnp.zeros_like(start).at[1:, 2].set(-GRAVITY)
    return Scenario(
        scene=Scene(mesh, [0], air=air),
        start=start,
        path=jnp.zeros((2, 1, 3)),
        path_times=jnp.array([0.0, 1.0]),
        first_time=jnp.asarray(INTERVAL),
        interval=INTERVAL,
        num_frames=4,
        lead_in=1,
        substeps=2,
        brake=None if brake is None else jnp.asarray(brake),
        acceleration=falling,
    )


@pytest.mark.slow(group="motions")
def test_a_sheet_that_is_let_go_falls_freely_from_the_first_step_on(fabric):
    scenario = dropped()
    corner = 8  # farthest from the held one, which it does not feel yet
    soft = dataclasses.replace(fabric, membrane=jax.tree.map(lambda c: 1e-3 * c, fabric.membrane))
    x = _motion(scenario, soft).x
    times = INTERVAL * np.arange(1, 5)
    fallen = -np.asarray(x[:, corner, 2])
    assert fallen == pytest.approx(GRAVITY * times**2 / 2, rel=1e-3)
    at_rest = dataclasses.replace(scenario, acceleration=jnp.zeros_like(scenario.start))
    lag = fallen + np.asarray(_motion(at_rest, soft).x[:, corner, 2])
    # the velocity lags by half of what a step of 10 ms brings
    assert np.diff(lag)[1:] == pytest.approx(GRAVITY * INTERVAL / 4 * INTERVAL, rel=0.05)


def test_the_first_acceleration_reaches_a_braked_solver():
    scenario = dropped(brake=5.0)
    solver, _ = stepped(scenario)
    state = begin(solver, scenario)
    assert jnp.all(state.inner.v_before[1:, 2] == GRAVITY * solver.dt)

    free = ImplicitCloth(scenario.scene, 0.01)
    assert jnp.all(begin(free, dataclasses.replace(scenario, acceleration=None)).v_before == 0)


@needs_data
def test_the_first_acceleration_is_what_the_other_simulator_does_first():
    made = runs.read(runs.DATA, runs.WIND.format("camel"))
    acceleration = runs.first_acceleration(made)
    # its frame at 0.04 s, after four steps that each look at the air before them
    gained = made.x[1] - made.start
    free = np.arange(27)  # the lowest three rows, which do not feel the handles yet
    steps = 4 * 5 / 2 * 0.01**2
    assert gained[free, 2] == pytest.approx(acceleration[free, 2] * steps, rel=0.05)
    along = gained[free, 1].mean() / (acceleration[free, 1].mean() * steps)
    assert 0.4 < along < 1  # the sheet gives way to the wind


@pytest.mark.slow(group="estimates")
@needs_data
@pytest.mark.parametrize(
    ("name", "bound", "budget"),  # [% of the side]; camel's descents take longer to arrive
    [("denim", 2.0, Budget(24, 2, 20)), ("camel", 2.9, Budget(24, 3, 60))],
)
def test_an_estimate_predicts_another_support_and_the_wind(name, bound, budget):
    edge, wind = runs.EDGE.format(name), runs.WIND.format(name)
    density = runs.read(runs.DATA, wind).told["material_json"]["density"]
    found = runs.estimated(name, 2000, budget).fabric
    assert runs.worst_error(edge, found, at_rest=True) < 1
    error = runs.worst_error(wind, found)
    default = runs.worst_error(wind, OrthotropicSpace.make(density).middle())
    assert error < min(bound, 0.55 * default)
