"""Estimators: from recordings of a sheet to its fabric.

In reading order:

- `method`, `methods`: the contract `Method.estimate`, and all `METHODS`.
- `estimate`, `cards`, `checkpoint`: results and their files.
- `problem`, `prediction`: a recording to be explained; what it would show of a fabric.
- `hanging_start`: the shape that a hanging sheet starts in.
- `normal_equations`, `least_squares`, `gauss_newton`, `descent`: the loss, steps, whole descents.
- `standard_errors`, `consistency`, `judgement`: standard errors and checks of the end.
- `mesh_refinement`: from a coarse mesh to one that resolves the fabric.
- `held_out`: a test on a recording that was not used.
- `physnet`, `pinn`: the methods that train networks.
"""
