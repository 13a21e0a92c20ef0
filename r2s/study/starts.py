"""From what shape a prediction of a hanging sheet starts: from that of the truth.

A sheet that hangs from corners drawn together buckles, and rests in one of several shapes. Into
which one a simulation falls from a flat sheet depends on its mesh and its fabric: the true fabric
on another mesh can begin a centimetre off. The cloud of the first frame does not fix it either: a
sheet laid onto it lies 2 mm off, and leaves for another shape within a fifth of a second. From the
truth's own shape the true fabric stays in it.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.interpolate import RegularGridInterpolator

from r2s.scenarios.scenario import Scenario

# [s], braked: another fabric comes to rest near the truth's shape. After 3 s it is elsewhere by
# 1.8 mm at most, later; after 0.4 s by 4.6.
SETTLING = 0.75

Shape = Float[np.ndarray, "row column 3"]


def started(scenario: Scenario, shape: Shape | None) -> Scenario:
    """A scenario whose sheet starts in a shape, settles for `SETTLING`, and then moves.

    - `shape`: places [m] of an even grid of the sheet in the first frame, along warp and weft;
      None: none is known, and the scenario is left as it is.

    The grippers start where their path begins. Raises `ValueError` for a sheet that lies on the
    table, which starts flat.
    """
    if shape is None:
        return scenario
    if scenario.brake is None:
        raise ValueError("a sheet that lies on the table starts flat, but a shape was given")
    rest = np.asarray(scenario.scene.mesh.rest, np.float64)
    along = tuple(np.linspace(0, 1, count) for count in shape.shape[:2])
    start = RegularGridInterpolator(along, shape)(np.clip(rest / rest.max(axis=0), 0, 1))
    held = scenario.path[1]
    return dataclasses.replace(
        scenario,
        start=scenario.scene.place(jnp.asarray(start, float), held),
        path=scenario.path.at[0].set(held),
        lead_in=math.ceil(SETTLING / scenario.interval),
    )
