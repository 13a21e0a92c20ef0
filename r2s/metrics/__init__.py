"""How near a simulation comes to a recording.

- `distances`: Chamfer and Hausdorff distance. `losses`: differentiable distances.
- `prediction_error`: the figures of a predicted motion. `placement`: where a recording lies
  nearest.
- `surface_distance`: zero for the sheet itself. `horizon`: floor, horizon and skill.
  `phase_free`: what is left to compare beyond the horizon.
- `statistics`: intervals and tests for such figures.
"""
