"""The study: each approach estimates from each scenario, and is evaluated on motions never seen.

- `plan`: the tasks of a study. `recordings`, `mujoco`: what they estimate from and evaluate on.
- `estimates`, `evaluations`, `ensembles`: the tasks; `tasks` and `engine` run them.
- `results`: the results as one table, `results.csv`.
- `conclusions`: what they say of the paper's. `report`: tables, figures and motions on one page.
"""
