"""A physics-informed network: the stiffness of a fabric from stretchings, their markers and force.

Needs flax: `pip install 'r2s[pinn]'`.

- `pulls`: a stretching as the network takes it, from a recording or synthetic.
- `network`: (X, Y, t) to displacement, with derivatives in forward mode.
- `weak_form`: displacement, stress and load of a pull, and their virtual work.
- `training`: of the networks, by Adam. `equilibrium`: motions in equilibrium, by Galerkin's method.
- `estimator`: the stiffness whose motions fit best, and its covariance.
- `published_recipe`: of Ru et al. (2025). `method`: the contract of `r2s.estimation.method`.
"""
