"""How near a simulation comes to a recording.

- `metrics`: Chamfer and Hausdorff distance. `losses`: differentiable distances.
- `prediction_error`: the figures of a predicted motion. `placement`: where a recording lies
  nearest.
- `statistics`: intervals and tests for such figures.
"""
