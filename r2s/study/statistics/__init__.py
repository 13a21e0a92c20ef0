"""The analysis of a study: pure functions from tables of results to tables.

- `frame`: the results as one long table; errors, floors and skills with their intervals.
- `comparisons`: tests of which side is better, and ranks.
- `conclusions`: the paper's conclusions as such tests, and its tables.

Needs pandas and statsmodels: pip install 'r2s[study]'.
"""

from r2s._util.extras import require

require("pandas", "study", "the analysis of a study")
require("statsmodels", "study", "the analysis of a study")
