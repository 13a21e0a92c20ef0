"""The six scenarios of the study, for any fabric and either solver.

- `experiments`: lifting, wind, stretching, folding, fling, shaking; and varied at random.
- `points`: the same on material points.
- `forces`: those of the grippers.
- `energy_balance`: a motion with its forces, also on a clamp, and where the energy goes.
"""

from r2s.scenarios.energy import EnergyBalance, clamp_force, energy_balance
from r2s.scenarios.on_points import material_points, motion_of_points
from r2s.scenarios.six import (
    SIX,
    Experiment,
    fling,
    folding,
    lifting,
    shaking,
    stretching,
    varied,
    wind,
)

__all__ = [
    "SIX",
    "EnergyBalance",
    "Experiment",
    "energy_balance",
    "clamp_force",
    "fling",
    "folding",
    "lifting",
    "material_points",
    "motion_of_points",
    "shaking",
    "stretching",
    "varied",
    "wind",
]
