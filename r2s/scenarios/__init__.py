"""The six scenarios of the study, for any fabric and either solver.

- `experiments`: lifting, wind, stretching, folding, fling, shaking; and varied at random.
- `points`: the same on material points.
- `forces`: those of the grippers.
- `account`: a motion with its forces, also on a clamp, and where the energy goes.
"""

from r2s.scenarios.account import Account, account, clamp_force
from r2s.scenarios.experiments import (
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
from r2s.scenarios.points import material_points, motion_of_points

__all__ = [
    "SIX",
    "Account",
    "Experiment",
    "account",
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
