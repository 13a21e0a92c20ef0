"""A physics-informed network: the stiffness of a fabric from stretchings, their markers and force.

Needs flax: `pip install 'r2s[pinn]'`.
"""
