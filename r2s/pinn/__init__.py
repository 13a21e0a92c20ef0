"""A physics-informed network: the stiffness of a fabric from a stretching, its markers and force.

- `data`: what the network is given of a recording, and what is wrong with it.
- `network`: (X, Y, t) to displacement, with derivatives in forward mode.
- `laws`: strain, stress and its divergence, from the laws of `r2s.physics.membrane`.
- `losses`: markers, equation of motion, traction, free edges, clamps.
- `weak`: the same by virtual work. `balance`: the estimate and its covariance from it.
- `training`: Adam, then L-BFGS. `paper`: the paper's recipe.
- `synthetic`: recordings of a known fabric pulled along any direction.

`r2s.estimators.pinn` puts them together.
"""
