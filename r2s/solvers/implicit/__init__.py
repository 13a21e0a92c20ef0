"""Implicit steps: a sheet of triangles, implicit in time, differentiable.

- `cloth`: the solver, `init` and `step`.
- `potential`: the energy that one step minimises; `generalised_alpha`: in place of BDF2's.
- `newton`: its minimiser. `system`: sparse matrices over a mesh; `band`, `dissection`: factors.
"""
