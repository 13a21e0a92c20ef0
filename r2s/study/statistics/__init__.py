"""The analysis of a study: pure functions from tables of results to tables.

- `frame`: the results as one long table, `results.csv`.
- `means`: means over fabrics with their intervals; skill.
- `comparisons`: which of two sides is better, and what is known of it.
- `conclusions`: the conclusions of the paper as such comparisons; `paper`: its tables.
- `ranks`, `factors`: who is best more often, and what the distance depends on.

Needs pandas and statsmodels: pip install 'r2s[study]'.
"""

from r2s._util.extras import require

require("pandas", "study", "the analysis of a study")
require("statsmodels", "study", "the analysis of a study")
