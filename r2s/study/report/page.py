"""A report as one HTML file: sections of words, tables and figures in a template."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jinja2
import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from r2s.study.report.tables import MISSING, significant


class Section(NamedTuple):
    """A part of the report: paragraphs, tables by name with a caption, figures by title.

    `folded`: figures are drawn when a reader opens them, for a browser has few 3-D contexts.
    """

    heading: str
    words: Sequence[str] = ()
    tables: Mapping[str, tuple[str, pd.DataFrame]] = {}
    figures: Mapping[str, go.Figure] = {}
    folded: bool = False


def render(sections: Sequence[Section]) -> str:
    """The page as HTML, which needs no other file and no network."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters |= {"table": _html_table, "figure": _json_figure}
    template = environment.get_template("report.html.j2")
    return template.render(sections=sections, plotly=get_plotlyjs())


def _html_table(table: pd.DataFrame) -> str:
    form = {"float_format": significant, "na_rep": MISSING}
    table = table.replace("", np.nan).dropna(axis=1, how="all")
    return table.to_html(index=False, border=0, classes="sortable", **form)


def _json_figure(figure: go.Figure) -> str:
    text = figure.update_layout(template="plotly_white").to_json() or ""
    return text.replace("<", "\\u003c")  # "<" would end the element that holds it
