"""Which mesh, step and grid are fine enough for a fabric and a motion.

The error of a mesh depends on the length of its cells over the fabric's bending length
(`r2s.bending_length`). `TABLE` is measured (`experiments/mesh_error.py`, sheets of 0.45 m):
geometric means over five fabrics of the distance from 33 x 33 vertices, and for the error of these
the share that the power `ORDER` leaves. Logarithms are interpolated; beyond the table the error is
that power of the cells' length.
"""

import math

import numpy as np

from r2s.compilation import compile_once
from r2s.materials.fabric import Fabric, bending_length
from r2s.scenarios.scenario import Scenario
from r2s.scenarios.standard import SIDE
from r2s.solvers.explicit.cloth import ExplicitCloth
from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.sheet import MPMCloth, longest_edge, stable_step

Shape = tuple[int, int]

# by motion: cell / fold length [-], and error [m], rms over the sheet and mean over the motion
TABLE: dict[str, tuple[tuple[float, float], ...]] = {
    "lifting": ((0.83, 2.7e-3), (1.66, 5.5e-3), (3.31, 6.4e-3)),
    "wind": ((0.83, 7.8e-3), (1.66, 15.7e-3), (3.31, 22.5e-3)),
    "folding": ((0.83, 4.9e-3), (1.66, 9.9e-3), (3.31, 19.6e-3)),
    "drape": ((0.83, 1.5e-3), (1.66, 3.0e-3), (3.31, 5.1e-3)),
    "hang": ((0.83, 6.9e-3), (1.66, 13.7e-3), (3.31, 18.3e-3)),
    "fling": ((0.83, 12.9e-3), (1.66, 25.8e-3), (3.31, 31.9e-3)),
}
SAME = {"lift": "lifting", "fold": "folding"}  # names that recordings have
TAUT = ("stretching",)  # motions without folds, not measured
ORDER = 1.0  # of the error in the cells' length, where it is not measured
ENOUGH = 6e-3  # [m], error of a mesh that is fine enough, of sheets of the study's size: a choice
LADDER = (9, 17, 33)  # vertices along the longer side

_bending_length = compile_once(bending_length)  # the derivatives in it take seconds one by one


def mesh_error(fabric: Fabric, size: tuple[float, float], shape: Shape, motion: str) -> float:
    """Expected error [m] of a motion on a mesh, rms over the sheet and mean over the motion.

    - `size`: of the sheet, [m]. `shape`: of the mesh, vertices along warp and weft.
    - `motion`: one of `TABLE`, or its name in recordings (`SAME`); for others the largest error of
      all, NaN for those in `TAUT`.

    Infinite for a fabric without bending. Fabrics scatter about it by a factor of 1.7.
    """
    motion = SAME.get(motion, motion)
    if motion in TAUT:
        return math.nan
    cell, length = longest_cell(size, shape), float(_bending_length(fabric))
    if not length:
        return math.inf
    ratio = cell / length
    tables = [TABLE[motion]] if motion in TABLE else list(TABLE.values())
    return max(max(size) / SIDE * _interpolated(table, ratio) for table in tables)


def _interpolated(table: tuple[tuple[float, float], ...], ratio: float) -> float:
    ratios, errors = np.array(table).T
    inside = np.clip(ratio, ratios[0], ratios[-1])
    error = np.exp(np.interp(np.log(inside), np.log(ratios), np.log(errors)))
    return float(error * (ratio / inside) ** ORDER)


def longest_cell(size: tuple[float, float], shape: Shape) -> float:
    """The longer side [m] of a rectangle's cells. Raises `ValueError` for a shape without cells."""
    if min(shape) < 2:
        raise ValueError(f"shape: expected at least 2 vertices along either side, got {shape}")
    return max(side / (count - 1) for side, count in zip(size, shape, strict=True))


def shape_for(fabric: Fabric, size: tuple[float, float], motion: str) -> Shape:
    """The coarsest of some meshes (`ladder`) whose error is at most `ENOUGH`; else the finest.

    >>> from r2s.materials import presets
    >>> shape_for(presets.black_denim(), (0.45, 0.45), "lifting")
    (17, 17)
    """
    enough = ENOUGH * max(size) / SIDE
    for shape in ladder(size):
        if not mesh_error(fabric, size, shape, motion) > enough:  # NaN: no folds to resolve
            return shape
    return ladder(size)[-1]


def ladder(size: tuple[float, float]) -> list[Shape]:
    """Meshes of a sheet [m] from coarse to fine, the cells of each half as long as those before."""
    longer = max(size)

    def cells(count: int, side: float) -> int:
        return max(math.ceil((count - 1) * side / longer - 1e-6), 2)

    return [(cells(n, size[0]) + 1, cells(n, size[1]) + 1) for n in LADDER]


def matching_shape(shape: Shape, size: tuple[float, float]) -> Shape:
    """The mesh of the `ladder` of another `size` [m] with as many vertices along its longer side as
    a `shape`; if it has none, the shape itself."""
    return next((mesh for mesh in ladder(size) if max(mesh) == max(shape)), shape)


def warning(fabric: Fabric, size: tuple[float, float], shape: Shape, motion: str) -> str:
    """A warning with the expected error when a mesh is too coarse for a fabric; else empty."""
    error = mesh_error(fabric, size, shape, motion)
    if not error > ENOUGH * max(size) / SIDE:
        return ""
    return (
        f"a mesh of {shape[0]} x {shape[1]} is coarse for this fabric: it folds at "
        f"{1e3 * float(_bending_length(fabric)):.0f} mm, the cells are "
        f"{1e3 * longest_cell(size, shape):.0f} mm long, so that a motion is expected to be "
        f"{1e3 * error:.0f} mm off ({advice(fabric, size, shape, motion)})"
    )


def advice(fabric: Fabric, size: tuple[float, float], shape: Shape, motion: str) -> str:
    """What to take instead of a mesh that is too coarse, in a few words."""
    finer = shape_for(fabric, size, motion)
    is_finer = longest_cell(size, finer) < (1 - 1e-6) * longest_cell(size, shape)
    return f"try {finer[0]} x {finer[1]}" if is_finer else "the finest that was measured, or finer"


# [s]: a pinned vertex goes straight in a step. At 10 m/s^2 that is off by 0.09 mm in the middle.
MAX_EXPLICIT_STEP = 1 / 120
MEMBRANE_DAMPING = 1e-4  # [s]: longer ones cost ten times as many steps, with the same motion
EDGE = 1.5  # longest edge of the mesh over the grid's spacing
STRETCHED = 1.3  # how much longer the way from a gripper to a vertex may be than at rest


def explicit_cloth(
    scenario: Scenario,
    fabric: Fabric,
    membrane_damping: float | None = None,
) -> ExplicitCloth:
    """A solver in explicit steps for a scenario: `rollout(scenario, fabric, solver=...)`.

    `fabric` is the stiffest that it will be used for, or a batch of all of them; `membrane_damping`
    [s] as in `r2s.ExplicitCloth`. Steps of at most `MAX_EXPLICIT_STEP` fill the time between
    frames. Raises `ValueError` for a scenario with self-contact.
    """
    steps = max(scenario.substeps, math.ceil(scenario.interval / MAX_EXPLICIT_STEP - 1e-9))
    return ExplicitCloth(
        scenario.scene,
        scenario.interval / steps,
        fabric,
        membrane_damping,
        self_contact=scenario.self_contact,
    )


def mpm_cloth(
    scenario: Scenario,
    fabric: Fabric,
    spacing: float | None = None,
    membrane_damping: float | None = MEMBRANE_DAMPING,
) -> MPMCloth:
    """A solver of material points for a scenario: `rollout(scenario, fabric, solver=...)`.

    `fabric` is the stiffest that it will be used for. The grid's `spacing` [m] is by default the
    mesh's longest edge over `EDGE`; `membrane_damping` [s] as in `r2s.MPMCloth`. Raises
    `ValueError` when the mesh is too coarse for the grid, or the scenario has self-contact.
    """
    if scenario.self_contact:
        raise ValueError(
            "self-contact of material points comes from the grid: make the scenario without it"
        )
    mesh = scenario.scene.mesh
    spacing = longest_edge(mesh) / EDGE if spacing is None else spacing
    limit = float(stable_step(mesh, spacing, fabric, membrane_damping))
    substeps = max(scenario.substeps, math.ceil(scenario.interval / limit))
    # the limit is in float32, and a step must not be above it by a rounding
    dt = scenario.interval / (substeps + 1)
    grid = grid_around(scenario, spacing)
    return MPMCloth(scenario.scene, dt, fabric, grid, membrane_damping)


def grid_around(scenario: Scenario, spacing: float) -> Grid:
    """The grid of where a sheet can be, held as it is; a node lies on the table where it reaches.

    No vertex is farther from the nearest gripper than `STRETCHED` times the way in the sheet.
    """
    path, start = np.asarray(scenario.path), np.asarray(scenario.start)
    rest, pinned = np.asarray(scenario.scene.mesh.rest), np.asarray(scenario.scene.pinned)
    away = np.linalg.norm(rest[:, None] - rest[pinned][None], axis=2)
    reach = STRETCHED * away.min(axis=1, initial=np.inf).max()
    if not len(pinned):
        raise ValueError("a grid can't be chosen for a sheet that nothing holds: make the MPMCloth")
    lower = np.minimum(path.min(axis=(0, 1)) - reach, start.min(axis=0))
    upper = np.maximum(path.max(axis=(0, 1)) + reach, start.max(axis=0))
    lower[2] = max(lower[2], float(scenario.scene.table.height))
    return Grid.covering(tuple(lower.tolist()), tuple(upper.tolist()), spacing)
