"""Sheets at rest, against their balance of forces; the energy of a swing; waves of a strip."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    DT,
    FIRST_ROW,
    SIZE,
    cloth,
    energy,
    flat,
    hanging,
    roll,
    rotation,
    stretch_under,
    strip,
)

from r2s._util.units import GRAVITY
from r2s.environment.contact import PRESSURE_STIFFNESS, pressure
from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.potential import residual

LONG = 5.0  # [s]: in a step as long as this, inertia and damping hardly count
DENSITY = 0.2  # [kg/m^2]
LENGTH, WIDTH, CELLS = 0.2, 0.025, 16  # of a strip, [m]
force = eqx.filter_jit(residual)


def pull(solver, fabric, states):
    """Forces [N] with which the grippers hold a sheet that is at rest in the last of its states."""
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), states)
    control = Control(state.x[solver.scene.pinned], jnp.zeros(3))
    return np.asarray(force(solver.potential(fabric, state, control), state.x))[solver.scene.pinned]


# A strip that hangs, and gets narrower


def hung(law, axis: int, tension):
    """Stretch along and across (-) of a strip without stress across, under tensions [N/m]."""
    c11, c12, c22, _ = law if axis == 0 else (law[2], law[1], law[0], law[3])
    along = np.array([stretch_under(t, c11 - c12**2 / c22) for t in tension])
    return along, np.sqrt(1 - c12 / c22 * (along**2 - 1))


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("law", [(20.0, 8.0, 12.0, 6.0), (900.0, 200.0, 1500.0, 100.0)])
@pytest.mark.parametrize("axis", [0, 1], ids=["warp", "weft"])
def test_a_hanging_strip_gets_longer_and_narrower_under_its_weight(axis, law):
    mesh = strip(axis, (LENGTH, WIDTH), (CELLS, 2))
    below, across = LENGTH - np.asarray(mesh.rest[:, axis]), np.asarray(mesh.rest[:, 1 - axis])
    fabric = Fabric.make(DENSITY, law, 1e-6)
    top = below > LENGTH * (1 - 0.5 / CELLS)
    narrow = np.where(top, hung(law, axis, [DENSITY * GRAVITY * LENGTH])[1], 1)
    start = np.stack([(across - WIDTH / 2) * narrow, 0 * across, below], axis=1)
    solver = cloth(mesh, np.flatnonzero(top), dt=LONG)
    x = roll(solver, fabric, solver.init(jnp.asarray(start)), 6).x[-1]
    order = np.lexsort((across, -below))
    heights, widths = x[order, 2].reshape(-1, 3), np.ptp(x[order, 0].reshape(-1, 3), axis=1)
    middles = LENGTH * (np.arange(2000) + 0.5) / 2000
    stretch = np.mean(hung(law, axis, DENSITY * GRAVITY * middles)[0]) - 1
    found = (heights[0] - heights[-1]).mean() / LENGTH - 1
    assert found == pytest.approx(stretch, rel=0.01)
    expected = hung(law, axis, DENSITY * GRAVITY * below[order][::3])[1]
    contraction = 1 - widths / WIDTH
    # but for the last row, which has strain on one side only
    assert contraction[:-1] == pytest.approx(1 - expected[:-1], abs=0.01 * (1 - expected[0]))


# A strip that is pulled by its ends


def pulled(law, angle: float, stretch: float):
    """The uniform deformation (2, 2) [-] of a strip with free sides, and its tension [N/m].

    It is cut at an angle [rad] to the warp and pulled along its length.
    """
    c11, c12, c22, c33 = law
    stiffness = np.array([[c11, c12, 0], [c12, c22, 0], [0, 0, c33]])
    c, s = np.cos(angle), np.sin(angle)
    # stress (S11, S22, S12) in the material axes of a unit tension along the strip
    unit = np.array([c**2, s**2, c * s])
    e11, e22, shear = np.linalg.solve(stiffness, unit)
    turn = np.array([[c, s], [-s, c]])
    strain = turn @ np.array([[e11, shear / 2], [shear / 2, e22]]) @ turn.T
    tension = (stretch**2 - 1) / 2 / strain[0, 0]
    # upper triangular, so that the length keeps its direction
    return np.linalg.cholesky(np.eye(2) + 2 * tension * strain).T, tension * stretch


ENDS = np.r_[0:5, 20:25]


def strip_cut_at(degrees, sheet, fabric):
    """A solver for a strip cut at an angle to the warp, its uniform strain when pulled by 10 % on
    a table without friction [m], and the force at its ends [N]."""
    law, angle = (300.0, 60.0, 200.0, 80.0), np.deg2rad(degrees)
    back = np.asarray(rotation(angle, 2))[:2, :2]
    mesh = Mesh.make(np.asarray(sheet.rest) @ back.T, np.asarray(sheet.faces))
    gradient, tension = pulled(law, angle, 1.1)
    height = float(fabric.thickness) - (DENSITY * GRAVITY / PRESSURE_STIFFNESS) ** 0.5
    flat_x = np.asarray(sheet.rest) @ gradient.T
    x = np.pad(flat_x, ((0, 0), (0, 1)), constant_values=height)
    return cloth(mesh, ENDS, table=0.0, dt=LONG), x, tension * SIZE


@pytest.fixture
def smooth():
    """A fabric without friction."""
    return Fabric.make(DENSITY, (300.0, 60.0, 200.0, 80.0), 1e-6, friction=0.0)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("degrees", [0, 30, 90, -60])
def test_a_strip_pulled_by_its_ends_strains_uniformly_and_balances_its_tension(
    degrees, sheet, smooth
):
    solver, x, tension = strip_cut_at(degrees, sheet, smooth)
    state = solver.init(jnp.asarray(x))
    control = Control(state.x[ENDS], jnp.zeros(3))
    forces = np.asarray(force(solver.potential(smooth, state, control), state.x))
    assert np.delete(forces, ENDS, axis=0) == pytest.approx(0, abs=1e-12 * tension)
    ends = forces[ENDS].reshape(2, 5, 3).sum(axis=1)
    expected = np.array([[-tension, 0, 0], [tension, 0, 0]])
    assert ends == pytest.approx(expected, abs=1e-12 * tension)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(25, 3)) * [1, 1, 0.01]
    noise[ENDS] = 0
    states = roll(solver, smooth, solver.init(jnp.asarray(x + noise)), 6)
    assert states.x[-1] == pytest.approx(x, abs=1e-10)


# A sheet on the table


@pytest.mark.slow(group="cloth")
def test_table_and_grippers_carry_the_weight(sheet):
    # without friction, with which a sheet that is pulled sideways creeps for long
    law = (300.0, 60.0, 200.0, 80.0)
    fabric = Fabric.make(DENSITY, law, 2e-5, damping=0.05, friction=0.0, mass_damping=10.0)
    solver = cloth(sheet, FIRST_ROW, table=0.0)
    start = flat(sheet, float(fabric.thickness))
    lifted = jnp.array([[0.03, 0.0, 0.05]])
    states = roll(solver, fabric, solver.init(start), 250, lambda t: start[:5] + min(t, 1) * lifted)
    x = jnp.asarray(states.x[-1])
    depth = solver.scene.table.depth(x, fabric.thickness)
    table = float(jnp.sum(sheet.vertex_area * pressure(depth)))
    grippers = pull(solver, fabric, states)[:, 2].sum()
    weight = DENSITY * SIZE**2 * GRAVITY
    assert 0.5 < table / weight < 0.8
    assert table + grippers == pytest.approx(weight, rel=1e-4)


# Energy


@pytest.fixture(scope="module")
def settled(sheet):
    """Where a sheet comes to rest that hangs from its first row."""
    fabric = Fabric.make(DENSITY, (300.0, 60.0, 200.0, 80.0), 2e-5, damping=0.1)
    solver = cloth(sheet, FIRST_ROW)
    return jnp.asarray(roll(solver, fabric, solver.init(hanging(sheet)), 400).x[-1])


def swing(sheet, settled, rate: float, damping: float, dt: float = DT):
    """Energies of a sheet in a swing of 1 s, over what a push of some [rad/s] gives it at rest."""
    fabric = Fabric.make(DENSITY, (300.0, 60.0, 200.0, 80.0), 2e-5, damping=damping)
    solver = cloth(sheet, FIRST_ROW, dt=dt)
    push = rate * jnp.stack([-settled[:, 2], 0 * settled[:, 2], settled[:, 0]], axis=1)
    states = roll(solver, fabric, solver.init(settled, push), round(1 / dt))
    found = jax.vmap(lambda x, v: energy(sheet, fabric, x, v))(states.x, states.v)
    least = energy(sheet, fabric, settled, jnp.zeros_like(settled))
    return np.asarray((found - least) / (found[0] - least))


def rise(energies):
    """The most that an energy rises above what it was before."""
    return np.max(energies - np.minimum.accumulate(energies))


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_a_small_swing_loses_energy_in_every_step(damping, sheet, settled):
    energies = swing(sheet, settled, 0.5, damping)
    assert np.all(np.diff(energies) < 0)
    assert energies[-1] > 0.97  # but no more than its damping takes


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_the_energy_of_a_wide_swing_hardly_rises(damping, sheet, settled):
    # 35 degrees; BDF2 bounds another energy, of two steps
    assert rise(swing(sheet, settled, 5.0, damping)) < 0.006


@pytest.mark.slow(group="cloth")
def test_the_rise_of_energy_is_of_second_order(sheet, settled):
    coarse, medium, fine = (rise(swing(sheet, settled, 5.0, 0.01, DT / n)) for n in (1, 2, 4))
    assert coarse > 4 * medium > 16 * fine


# Standing waves of a strip

PERIOD = 0.05  # of the first standing wave, twice the length, [s]
STIFFNESS = DENSITY * (2 * LENGTH / PERIOD) ** 2  # [N/m] of that speed
STEP = PERIOD / 100  # [s]
AMPLITUDE = 1e-5 * LENGTH  # [m]


def plain_strip(axis: int):
    """A strip along warp (0) or weft (1), and how far along it its vertices are [m].

    Its cells do not wrinkle: without bending they would give way to half of every wave.
    """
    mesh = strip(axis, (LENGTH, WIDTH), (CELLS, 2), "quadrilaterals")
    return mesh, np.asarray(mesh.rest[:, axis])


def membrane(along: float, across: float, shear: float, axis: int):
    """C11, C12, C22, C33 [N/m] of a strip along warp (0) or weft (1)."""
    return (along, 0.0, across, shear) if axis == 0 else (across, 0.0, along, shear)


def period(solver, fabric, rest, shape):
    """Period [s] of a wave of this shape (vertex, 3), let go of around a state of rest.

    From the times at which it goes through zero for the first and the third time. A wave on 16
    cells is 0.16 % slow, one of half the length 0.64 %, and BDF2 adds (2 pi / 100)^2 / 3 = 0.13 %.
    """
    start = jnp.asarray(rest + AMPLITUDE * shape)
    moved = roll(solver, fabric, solver.init(start), 135).x - rest
    wave = np.einsum("tvi,vi->t", moved, shape) / np.sum(shape**2) / AMPLITUDE
    before = np.flatnonzero(np.sign(wave[1:]) != np.sign(wave[:-1]))
    crossings = before + wave[before] / (wave[before] - wave[before + 1])
    return solver.dt * (crossings[2] - crossings[0])


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("kind", ["longitudinal", "shear"])
@pytest.mark.parametrize("axis", [0, 1], ids=["warp", "weft"])
def test_waves_in_the_plane_have_the_speed_of_their_stiffness(axis, kind):
    mesh, along = plain_strip(axis)
    shape = np.zeros((len(along), 3))
    if kind == "longitudinal":
        law = membrane(STIFFNESS, 9.0, 4.0, axis)
        shape[:, axis] = np.cos(np.pi * along / LENGTH)  # free ends
    else:
        # Yarns that hardly stretch keep the rows from turning one by one, as they do in a bent
        # strip. The second wave, since in the first the whole strip would turn.
        law = membrane(1e5 * STIFFNESS, 9.0, STIFFNESS / 4, axis)
        shape[:, 1 - axis] = np.cos(2 * np.pi * along / LENGTH)
    fabric = Fabric.make(DENSITY, law, 0.0, damping=0.0)
    found = period(cloth(mesh, dt=STEP), fabric, np.asarray(flat(mesh)), shape)
    assert found == pytest.approx(PERIOD, rel=0.01)


def taut(along, stiffness: float, tension: float):
    """Heights [m] of a strip that hangs with a tension [N/m] in its middle, and the stretch there.

    Its tension grows upwards by the weight below.
    """
    cell = LENGTH / CELLS
    middles = cell * (np.arange(CELLS) + 0.5)
    tensions = tension + DENSITY * GRAVITY * (middles - LENGTH / 2)
    stretches = [stretch_under(t, stiffness) for t in tensions]
    heights = cell * np.concatenate([[0], np.cumsum(stretches)])
    return heights[np.rint(along / cell).astype(int)], stretch_under(tension, stiffness)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("axis", [0, 1], ids=["warp", "weft"])
def test_transverse_waves_have_the_speed_of_the_tension(axis):
    mesh, along = plain_strip(axis)
    stiffness = 100 * STIFFNESS
    heights, stretch = taut(along, stiffness, STIFFNESS)
    fabric = Fabric.make(DENSITY, membrane(stiffness, 9.0, 4.0, axis), 0.0, damping=0.0)
    across = np.asarray(mesh.rest[:, 1 - axis])
    rest = np.stack([across, 0 * across, heights], axis=1)
    shape = np.zeros((len(along), 3))
    shape[:, 1] = np.sin(np.pi * along / LENGTH)  # held ends
    held = np.flatnonzero((along == along.min()) | (along == along.max()))
    found = period(cloth(mesh, held, dt=STEP), fabric, rest, shape)
    # sqrt(tension / density) for lengths and areas as stretched
    assert found == pytest.approx(PERIOD * stretch**0.5, rel=0.01)
