"""Explicit steps, and the forces of a sheet on its vertices; material points use them, too.

- `cloth`: the solver, `init` and `step`.
- `sheet`: all of them, from substep to substep.
- `elements`: of membrane and bending on any mesh, bounds on their frequencies, and what a substep
  does to a vertex.
- `grid`, `grid_membrane`, `grid_bending`: the same on the grid of a `rectangle`, by slices;
  `layout`: how its arrays lie, with a batch as the last axis.
- `stability`: how long substeps may be; a viscosity of the membrane that does not shorten them.
- `laws`: what the laws of one element say of arrays side by side.
"""
