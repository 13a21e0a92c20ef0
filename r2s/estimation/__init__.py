"""Estimators: from recordings of a sheet to its fabric.

In reading order:

- `method`, `registry`: the contract `Method.estimate`, and all `METHODS` by name.
- `estimate`, `estimate_json`, `cards`: what comes out, and its files.
- `problem`, `initial_shape`: a recording to be explained, and how its sheet hangs at first.
- `prediction`, `normal_equations`, `gauss_newton`: predictions, losses, steps.
- `descent`, `standard_errors`, `checkpoint`: whole descents, and how well the end is known.
- `diffcloud`, `diffcp`, `cma_es`, `physnet`, `pinn`: the methods.
- `adam`: how the published recipes descend.
- `identifiability`, `experiment_design`: what a recording or a motion reveals of a fabric.
"""
