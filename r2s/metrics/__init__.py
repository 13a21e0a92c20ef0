"""How near a simulation comes to a recording.

- `prediction_error`: Chamfer and Hausdorff distances, figures of a predicted motion, placement.
- `losses`: differentiable distances, and the distance from a surface.
- `horizon`: floor, predictability horizon, skill; features that do not depend on the phase.
- `statistics`: intervals and tests for such figures.
"""
