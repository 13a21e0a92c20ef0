"""The six scenarios of the study, for any fabric and solver.

- `scenario`: a sheet at rest, what holds it, how that moves, which frames count; `rollout`.
- `paths`: where what holds the sheet goes; the limits within which motions are drawn.
- `standard`: lifting, wind, stretching, folding, fling, shaking; a swing; varied at random.
- `resolution`: which mesh, step and grid are fine enough.
- `energy`: where the energy goes.
- `synthetic`: recordings of a known fabric, seen by cameras.
"""

from r2s.scenarios.energy import EnergyBalance, clamp_force, energy_balance
from r2s.scenarios.resolution import explicit_cloth, mpm_cloth
from r2s.scenarios.standard import (
    SCENARIOS,
    Experiment,
    fling,
    folding,
    lifting,
    shaking,
    stretching,
    swing,
    varied,
    wind,
)

__all__ = [
    "SCENARIOS",
    "EnergyBalance",
    "Experiment",
    "energy_balance",
    "clamp_force",
    "explicit_cloth",
    "fling",
    "folding",
    "lifting",
    "mpm_cloth",
    "shaking",
    "stretching",
    "swing",
    "varied",
    "wind",
]
