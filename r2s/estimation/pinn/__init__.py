"""A physics-informed network: the stiffness of a fabric from a stretching, its markers and force;
and from clouds of a sheet that is lifted or in the wind.

- `data`: what the network is given of a recording, and what is wrong with it.
- `network`: (X, Y, t) to displacement, with derivatives in forward mode.
- `laws`: strain, stress and its divergence, from the laws of `r2s.laws.membrane`.
- `losses`: markers, equation of motion, traction, free edges, clamps.
- `weak`: the same by virtual work. `balance`: the estimate and its covariance from it.
- `training`: Adam, then L-BFGS. `paper`: the paper's recipe.
- `synthetic`: recordings of a known fabric pulled along any direction.
- `levenberg`: Gauss and Newton's steps for all weights at once. `exact`: the network alone by them.
- `clouds`: points matched to the network's own map. `shell`: the balance of a sheet that hangs.

`r2s.estimation.pinn.from_pulls` and `r2s.estimation.pinn.from_clouds` put them together.
"""
