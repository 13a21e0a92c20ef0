"""Standing waves of a strip, against the speeds of longitudinal, shear and transverse waves."""

import conftest
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat, roll, stretch_under

from r2s._util.units import GRAVITY
from r2s.materials.fabric import Fabric

LENGTH, WIDTH = 0.2, 0.025  # [m]
CELLS = 16  # along the strip
DENSITY = 0.2  # [kg/m^2]
PERIOD = 0.05  # of the first standing wave, twice the length, [s]
STIFFNESS = DENSITY * (2 * LENGTH / PERIOD) ** 2  # [N/m] of that speed
STEP = PERIOD / 100  # [s]
AMPLITUDE = 1e-5 * LENGTH  # [m]


def strip(axis: int):
    """A strip along warp (0) or weft (1), and how far along it its vertices are [m].

    Its cells do not wrinkle: without bending they would give way to half of every wave.
    """
    mesh = conftest.strip(axis, (LENGTH, WIDTH), (CELLS, 2), "quadrilaterals")
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
    mesh, along = strip(axis)
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


def hung(along, stiffness: float, tension: float):
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
    mesh, along = strip(axis)
    stiffness = 100 * STIFFNESS
    heights, stretch = hung(along, stiffness, STIFFNESS)
    fabric = Fabric.make(DENSITY, membrane(stiffness, 9.0, 4.0, axis), 0.0, damping=0.0)
    across = np.asarray(mesh.rest[:, 1 - axis])
    rest = np.stack([across, 0 * across, heights], axis=1)
    shape = np.zeros((len(along), 3))
    shape[:, 1] = np.sin(np.pi * along / LENGTH)  # held ends
    held = np.flatnonzero((along == along.min()) | (along == along.max()))
    found = period(cloth(mesh, held, dt=STEP), fabric, rest, shape)
    # sqrt(tension / density) for lengths and areas as stretched
    assert found == pytest.approx(PERIOD * stretch**0.5, rel=0.01)
