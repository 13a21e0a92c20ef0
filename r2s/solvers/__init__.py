"""Solvers of cloth motions, and what is common to them.

- `implicit`, `explicit`: steps of a mesh. `mpm`: material points. `contact`: layers that touch.
- `simulate`: from steps to motions. `results`: how it ended.
- `sweep`: thousands of fabrics at once. `gradient_check`: derivatives against differences.
"""
