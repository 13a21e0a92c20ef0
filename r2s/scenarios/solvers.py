"""Solvers for a scenario beside the implicit cloth: explicit steps, and material points."""

import math

import numpy as np

from r2s.materials.fabric import Fabric
from r2s.scenarios.scenario import Scenario
from r2s.solvers.explicit.cloth import ExplicitCloth
from r2s.solvers.explicit.viscosity import RELAXATION
from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.sheet import Sheet, longest_edge, stable_step

# [s]: a held vertex goes straight in a step. At 10 m/s^2 its path is off by 0.09 mm in the middle.
MAX_EXPLICIT_STEP = 1 / 120
MEMBRANE_DAMPING = 1e-4  # [s]: what is longer costs ten times as many steps, and shows in no motion
EDGE = 1.5  # longest edge of the mesh over the grid's spacing
STRETCHED = 1.3  # how much longer the way from a gripper to a vertex may be than at rest


def explicit_cloth(
    scenario: Scenario,
    fabric: Fabric,
    membrane_damping: float | None = None,
    relaxation: float = RELAXATION,
) -> ExplicitCloth:
    """A solver in explicit steps for a scenario: `rollout(scenario, fabric, solver=...)`.

    `fabric` is the stiffest that it will be used for, or a batch of all of them. The membrane's
    damping time and relaxation [s] are as in `r2s.ExplicitCloth.make`. The steps, of at most
    `MAX_EXPLICIT_STEP`, fill the time between frames. Raises `ValueError` for a scenario with
    self-contact.
    """
    steps = max(scenario.substeps, math.ceil(scenario.interval / MAX_EXPLICIT_STEP - 1e-9))
    return ExplicitCloth.make(
        scenario.scene,
        scenario.interval / steps,
        fabric,
        membrane_damping,
        relaxation,
        self_contact=scenario.self_contact,
    )


def material_points(
    scenario: Scenario,
    fabric: Fabric,
    spacing: float | None = None,
    membrane_damping: float | None = MEMBRANE_DAMPING,
) -> Sheet:
    """A solver of material points for a scenario: `rollout(scenario, fabric, solver=...)`.

    `fabric` is the stiffest that it will be used for. The grid's `spacing` [m] is by default the
    mesh's longest edge over `EDGE`; folds that lie on each other are about a spacing apart. The
    membrane's damping time [s] is as in `r2s.solvers.mpm.Sheet`. Steps fill a frame.
    Raises `ValueError` when the mesh is too coarse for the grid, or the scenario has
    self-contact of the cloth.
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
    return Sheet.make(scenario.scene, grid_around(scenario, spacing), fabric, dt, membrane_damping)


def grid_around(scenario: Scenario, spacing: float) -> Grid:
    """The grid of where a sheet can be, held as it is; a node lies on the table where it reaches.

    No vertex is farther from the nearest gripper than `STRETCHED` times the way in the sheet.
    """
    path, start = np.asarray(scenario.path), np.asarray(scenario.start)
    rest, held = np.asarray(scenario.scene.mesh.rest), np.asarray(scenario.scene.held)
    away = np.linalg.norm(rest[:, None] - rest[held][None], axis=2)
    reach = STRETCHED * away.min(axis=1, initial=np.inf).max()
    if not len(held):
        raise ValueError("a grid can't be chosen for a sheet that nothing holds: make the Sheet")
    lower = np.minimum(path.min(axis=(0, 1)) - reach, start.min(axis=0))
    upper = np.maximum(path.max(axis=(0, 1)) + reach, start.max(axis=0))
    lower[2] = max(lower[2], float(scenario.scene.table.height))
    return Grid.covering(tuple(lower.tolist()), tuple(upper.tolist()), spacing)
