"""What a report begins with: the question, one picture that answers it, and three sentences."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from r2s.metrics.statistics import LEVEL
from r2s.study.report.charts import interval_chart
from r2s.study.report.tables import mean_text
from r2s.study.statistics import comparisons, frame, means

QUESTION = (
    "Which approach, on which solver and from which recording, finds a fabric that moves as the "
    "real one does?"
)


def picture(
    with_skill: pd.DataFrame, decided: pd.DataFrame, metric: str, colours: Mapping[str, str]
) -> dict[str, go.Figure]:
    """A chart of skills, or where none is known of mean distances, by its title.

    `with_skill`: rows that have a floor. `decided`: those of the metric that compares.
    """
    known = with_skill[with_skill.skill.notna()]
    if len(known):
        title = f"Skill in motions that no estimate has seen, with {LEVEL:.0%} intervals"
        marks = {0.0: "weight alone", 1.0: "floor"}
        return {title: interval_chart(means.means(known, "skill"), colours, "skill [-]", marks)}
    if len(decided):
        title = f"Mean {metric} in motions that no estimate has seen, with {LEVEL:.0%} intervals"
        return {title: interval_chart(means.means(decided), colours, f"{metric} [m]", {})}
    return {}


def sentences(
    decided: pd.DataFrame,
    with_skill: pd.DataFrame,
    judged: pd.DataFrame,
    fabrics: int,
    missing: int,
) -> list[str]:
    """What was done, what came out, and what it decides."""
    own = decided[decided.baseline == ""]
    runs, lost = len(own), int(own.diverged.sum())
    count = len(frame.configurations(decided))
    done = (
        f"{count} configurations (approach, solver, source) estimated {_number(fabrics, 'fabric')} "
        f"and were judged on {decided.recording.nunique()} recordings of "
        f"{', '.join(frame.motions(decided)) or 'no motion'}, which no estimate has seen: of "
        f"{runs} predictions {lost} diverged, and {_number(missing, 'cell')} of the study "
        f"{'is' if missing == 1 else 'are'} missing."
    )
    return [done, _best(own, with_skill[with_skill.baseline == ""]), _decides(judged, fabrics)]


def _best(own: pd.DataFrame, with_skill: pd.DataFrame) -> str:
    """The configuration with the best mean by motion, of those of which no run diverged."""
    known = with_skill[with_skill.skill.notna()]
    column, part = ("skill", known) if len(known) else ("value", own)
    found = []
    for motion in frame.motions(part):
        table = means.means(part[part.evaluated_on == motion], column).droplevel("evaluated_on")
        table = table[np.isfinite(table["mean"])]
        if len(table):
            label = table["mean"].idxmax() if column == "skill" else table["mean"].idxmin()
            write = "{:.2f}".format if column == "skill" else "{:.3g}".format
            found.append(f"in {motion} {label} ({mean_text(table.loc[label], write)})")
    if not found:
        return "No configuration has a result that could be compared."
    what = "The highest mean skill has" if column == "skill" else "The least mean distance has"
    return f"{what} {'; '.join(found)}."


def _decides(judged: pd.DataFrame, fabrics: int) -> str:
    if fabrics < 2:
        return (
            "One fabric decides nothing between approaches: differences between them may be those "
            "of this fabric, and there are no intervals and no tests."
        )
    found = list(comparisons.answers(judged).values())
    counts = ", ".join(
        f"{found.count(answer)} {words}"
        for answer, words in (("holds", "hold"), ("does not hold", "do not hold"))
    )
    return (
        f"Of the paper's {len(found)} conclusions {counts}, and "
        f"{found.count(comparisons.UNKNOWN)} cannot be told from {fabrics} fabrics."
    )


def _number(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
