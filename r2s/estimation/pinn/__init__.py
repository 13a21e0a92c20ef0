"""A physics-informed network: the stiffness of a fabric from stretchings, their markers and force.

Needs flax: `pip install 'r2s[pinn]'`.

- `from_pulls`: the estimate from stretchings. `pulls`: what it is given of a recording.
- `network`: (X, Y, t) to displacement, with derivatives in forward mode.
- `stress`: strain, stress and its divergence, from the laws of `r2s.laws.membrane`.
- `losses`: markers, equation of motion, traction, free edges, clamps. `weak_form`: virtual work.
- `training`: Adam, then L-BFGS. `balance`: motions in balance, the estimate and its covariance.
- `synthetic_pulls`: recordings of a known fabric. `published_recipe`: of Ru et al. (2025).
"""
