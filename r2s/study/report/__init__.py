"""The report of a study: `report.html`, one file that works without a network.

- `publish`: writes it and its tables; `opening`: what it begins with, in words.
- `charts`, `motion_figure`: plotly figures; `tables`: tables of text; `disclosures`: what the
  study was made with. `report.html.j2`: the page.

Needs plotly and Jinja2: pip install 'r2s[study]'.
"""

from r2s._util.extras import require

require("plotly", "study", "the report of a study")
require("jinja2", "study", "the report of a study")
