"""Explicit steps, and the forces of a sheet on its vertices; material points use them, too.

- `cloth`: the solver, `init` and `step`.
- `sheet`: all of them, from substep to substep.
- `elements`: of membrane and bending on any mesh, and bounds on their frequencies.
- `grid`: the same on the grid of a `rectangle`, by slices; `layout`: how its arrays lie.
- `batch_last`: members of a batch side by side.
- `viscosity`: of a membrane whose fast waves are not to shorten the steps; `stability`: how long
  these may be.
- `laws`: what the laws of one element say of arrays side by side.
"""
