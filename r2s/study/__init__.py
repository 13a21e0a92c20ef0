"""The study: each approach estimates from each scenario, and is judged on motions never seen.

The path of data, each step a module:

- `sources`: recordings, synthetic or given, to estimate from and to judge by.
- `estimates`: what each approach makes of them. `evaluations`: how near its fabric comes.
- `statistics`: the results as one table (`results.csv`), and what they say.
- `report`: tables, figures and motions on one page.

Sources, estimates and evaluations are `cells`, which `matrix` lays out by `configuration`, `engine`
(with `cluster`) makes, and `results` collects. `r2s.cli.study` does all of it.
"""
