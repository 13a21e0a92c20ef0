"""A physics-informed network: the stiffness of a fabric from stretchings, their markers and force.

Needs flax: `pip install 'r2s[pinn]'`.

- `from_pulls`: the estimate from stretchings. `pulls`: what it is given of a recording.
- `network`: (X, Y, t) to displacement, with derivatives in forward mode.
- `stress`: strain and stress, from the laws of `r2s.materials.membrane`.
- `losses`: displacements beside markers and clamps, the load. `weak_form`: virtual work.
- `training`: of the networks, by Adam. `equilibrium`: motions in equilibrium, by Galerkin's method.
- `balance`: the stiffness whose motions fit best, and its covariance.
- `synthetic_pulls`: recordings of a known fabric. `published_recipe`: of Ru et al. (2025).
"""
