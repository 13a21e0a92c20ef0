"""Explicit steps, and the forces of a sheet on its vertices; material points use them, too.

- `cloth`: the solver, `init` and `step`.
- `sheet`: the forces on any mesh. `grid`, `grid_bending`: the same on the grid of a `rectangle`, by
  slices; `layout`: how its arrays lie, with a batch as the last axis.
- `stability`: how long substeps may be; a viscosity of the membrane that does not shorten them.
"""
