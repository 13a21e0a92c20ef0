"""Implicit steps: a sheet of triangles, implicit in time, differentiable.

- `cloth`: the solver, `init` and `step`.
- `potential`: the energy that one step minimises. `newton`: its minimiser.
- `linear`: sparse matrices over a mesh, and their factor.
"""
