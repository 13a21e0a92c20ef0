"""The report of a study: `report.html`, one file that works without a network.

- `page`: its sections and words; `report.html.j2`: its template.
- `figures`: plotly figures. `tables`: tables of text, and of how the study was made.

Needs plotly and Jinja2: pip install 'r2s[study]'.
"""

from r2s._util.extras import require

require("plotly", "study", "the report of a study")
require("jinja2", "study", "the report of a study")
