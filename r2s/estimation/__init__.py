"""Estimators: from recordings of a sheet to its fabric.

In reading order:

- `method`, `registry`: the contract `Method.estimate`, and all `METHODS` by name.
- `estimate`, `estimate_json`, `cards`: what comes out, and its files.
- `problem`, `initial_shape`: a recording to be explained, and how its sheet hangs at first.
- `prediction`, `normal_equations`, `gauss_newton`: predictions, losses, steps.
- `compiled`: the same for many thetas, in compiled programs.
- `descent`, `standard_errors`, `checkpoint`: whole descents, and how well the end is known.
- `mesh_ladder`, `mesh_bias`: from a coarse mesh to one that resolves; what the mesh makes wrong.
- `diffcloud`, `diffcp`, `cma_es`, `physnet`, `pinn`: the methods.
- `adam`: how the published recipes descend.
- `identifiability`, `experiment_design`: what a recording or a motion reveals of a fabric.
"""
