"""The six scenarios of the study, for any fabric and solver.

- `scenario`: a sheet at rest, what holds it, how that moves, which frames count; `rollout`.
- `six`: lifting, wind, stretching, folding, fling, shaking; varied at random; a swing on a bar.
- `paths`: how grippers move in them.
- `on_points`, `in_explicit_steps`: the same on material points, and by explicit steps of the cloth.
- `energy`: where the energy goes.
- `synthetic`: recordings of a known fabric, seen by cameras.
"""

from r2s.scenarios.energy import EnergyBalance, clamp_force, energy_balance
from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.on_points import material_points
from r2s.scenarios.six import (
    SIX,
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
    "SIX",
    "EnergyBalance",
    "Experiment",
    "energy_balance",
    "clamp_force",
    "explicit_cloth",
    "fling",
    "folding",
    "lifting",
    "material_points",
    "shaking",
    "stretching",
    "swing",
    "varied",
    "wind",
]
