"""The scenes of the benchmark of the material point method."""

from typing import NamedTuple

import numpy as np

MU, LAM, MASS, VOLUME, GRAVITY, WALLS = 100.0, 100.0, 1.0, 1.0, 9.8, 3  # units of DiffTaichi


class Scene(NamedTuple):
    """A block of particles in a unit box, in the units of DiffTaichi.

    - `law`: "corotated" or "neo-hookean"; of the sheet, the fabric.
    - `x`: positions at the start; None for the sheet.
    - `v`: velocities, of a body that is thrown and torn, so that it is under stress.
    - `nodes`: along each axis.
    - `dt`, `steps`: of time.
    - `count`, `state_bytes`: particles, and the size of a state in float32.
    """

    law: str
    x: np.ndarray
    v: np.ndarray
    nodes: int
    dt: float
    steps: int
    count: int
    state_bytes: int


def _block(axes: int, count: int, nodes: int, dt: float, law: str, steps: int) -> Scene:
    x = np.random.default_rng(0).uniform(0.3, 0.6, (count, axes)).astype(np.float32)
    size = 4 * count * (2 * axes + 2 * axes**2)
    v = np.array((1.5, -2.0, 0.5)[:axes]) + 5 * (x - x.mean(axis=0)) * (1, -1, 0.5)[:axes]
    return Scene(law, x, v.astype(np.float32), nodes, dt, steps, count, size)


def plane(law: str, steps: int) -> Scene:
    """8,192 particles in 2-D."""
    return _block(2, 8192, 128, 1e-4, law, steps)


def space(law: str, steps: int) -> Scene:
    """6,912 particles in 3-D."""
    return _block(3, 6912, 32, 4e-4, law, steps)


def sheet(law: str, steps: int) -> Scene:
    """A sheet of 17 x 17 vertices and 512 faces."""
    size = 4 * (289 * (3 + 3 + 9) + 512 * 3)
    return Scene(law, np.zeros((289, 3)), np.zeros((289, 3)), 0, 0.0, steps, 289, size)


SCENES = {"2d": plane, "3d": space, "sheet": sheet}
