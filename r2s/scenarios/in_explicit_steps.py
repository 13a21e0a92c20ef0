"""Scenarios in explicit steps of the cloth."""

import math

from r2s.cloth.explicit import ExplicitCloth
from r2s.fabrics.fabric import Fabric
from r2s.forces.viscosity import RELAXATION
from r2s.scenarios.scenario import Scenario

# [s]: a held vertex goes straight in a step. At 10 m/s^2 its path is off by 0.09 mm in the middle.
MAX_STEP = 1 / 120


def explicit_cloth(
    scenario: Scenario,
    fabric: Fabric,
    membrane_damping: float | None = None,
    relaxation: float = RELAXATION,
) -> ExplicitCloth:
    """A solver in explicit steps for a scenario: `rollout(scenario, fabric, solver=...)`.

    `fabric` is the stiffest that it will be used for, or a batch of all of them. The membrane's
    damping time and relaxation [s] are as in `r2s.ExplicitCloth.make`. The steps, of at most
    `MAX_STEP`, fill the time between frames. Raises `ValueError` for a scenario with self-contact.
    """
    steps = max(scenario.substeps, math.ceil(scenario.interval / MAX_STEP - 1e-9))
    return ExplicitCloth.make(
        scenario.scene,
        scenario.interval / steps,
        fabric,
        membrane_damping,
        relaxation,
        self_contact=scenario.self_contact is not None,
    )
